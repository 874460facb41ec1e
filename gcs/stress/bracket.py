"""Where the search for an onset starts when no margin could be computed: the delays between which growth begins."""

from collections.abc import Callable

from gcs.stress.trial import Run, Trial

LINKS_S = (0.0, 0.05, 0.1, 0.2), (0.4, 0.8, 1.6)
"""Link delays (s), up plus down, that are flown to find out where errors begin to grow: the second if they do not in
the first."""


def bracketed(trial_at: Callable[[float], Trial], run: Run) -> tuple[float, float] | str:
    """The link delays between which errors begin to grow; or why there are none, in one line."""
    before_s = None
    for links_s in LINKS_S:
        outcomes = run([trial_at(link_s) for link_s in links_s])
        for link_s, growth_1_s in zip(links_s, (outcome.growth_1_s for outcome in outcomes), strict=True):
            if growth_1_s is None:
                return f"the margin is unknown, and no growth rate could be measured at {link_s:g} s of link delay"
            if growth_1_s > 0.0:
                if before_s is None:
                    return f"errors grow at {growth_1_s:+.4g} 1/s with the shortest link delay: no delay is stable"
                return before_s, link_s
            before_s = link_s
    return f"the margin is unknown, and errors decay in flights with up to {before_s:g} s of link delay"
