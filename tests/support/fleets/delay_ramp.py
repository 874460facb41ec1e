"""Links whose delay rises and falls again, for the tests of the monitor and of its log."""

from scenarios.keys.link import DelayPoint, Link, Links


def ramp(highest_s: float) -> Links:
    """From 20 ms each way at 10 s to a highest delay at 40 s, held for 10 s, and back within 8 s."""
    points = ((10.0, 0.02), (40.0, highest_s), (50.0, highest_s), (58.0, 0.02))
    link = Link(delay_points=tuple(DelayPoint(at_s=at_s, delay_s=delay_s) for at_s, delay_s in points))
    return Links(up=link, down=link)
