"""Further requirements of a design, and who hears whom; in the design, `gains.core.requirement.Criteria`."""

from typing import Annotated, Literal

from pydantic import Field

from scenarios.keys.part import NotNegative, Part, Positive


class Overlap(Part):
    """Which vehicles every vehicle hears, besides the one in front and those in its `hears`. Graph methods only."""

    ahead: Annotated[int, Field(ge=1, le=250)] = 1
    """Number of vehicles heard in front, one behind the other up to the leader."""
    behind: bool = False
    """Also hears every vehicle that follows it: with `ahead = 1`, both neighbours."""
    leader: bool = False
    """Also hears the leader."""


class Criteria(Part):
    """Further requirements of the gains, for `loop = "ground"` and vehicles that respond at once, or with `for_link`.

    The gains are then found by a search, at `at_delay_s` if it is given. The design meets the requirements, or refuses
    them and says how far each one alone would have to be relaxed.
    """

    at_delay_s: Positive | None = None
    """Loop delay for which the gains are optimised; requirements "at a delay" refer to it."""
    maximise: (
        Literal["alpha", "decay_rate_1_s", "alpha_at_delay", "decay_rate_at_delay_1_s", "delay_margin_s"] | None
    ) = None
    """The figure to maximise within the requirements. If omitted: `alpha_at_delay` with `at_delay_s`; without it, alpha
    if a delay margin is required, and else the delay margin."""
    alpha_at_delay: Positive | None = None
    """Requirement: least robustness bound at `at_delay_s`."""
    decay_rate_at_delay_1_s: Positive | None = None
    """Requirement: least decay rate at `at_delay_s`."""
    damping_min: Annotated[float, Field(gt=0, le=1)] | None = None
    """Requirement: least damping ratio of every root, without delay."""
    natural_frequency_max_rad_s: Positive | None = None
    """Requirement: largest natural frequency of every root, without delay."""
    spacing_gain_max_s2: Positive | None = None
    """Requirement: largest gain (H∞) from disturbing accelerations (m/s²) to spacing errors (m), at `at_delay_s`, or
    without delay."""
    noise_gain_max: Positive | None = None
    """Requirement: largest gain (H2) from measurement noise to commands, at `at_delay_s`, or without delay: the
    standard deviation of the noisiest command (m/s²) when every error is measured with white noise of 1 m and 1 m/s."""
    delays_s: tuple[NotNegative, NotNegative] | None = None
    """Requirement: the least and the largest loop delay; stability must be proved for every delay between them."""
    delay_rate: NotNegative | None = None
    """Largest rate of change of the delay in `delays_s`, s/s; 0: constant but unknown. Omitted: the delay may jump."""
    discrete: bool = False
    """Whether decay rate and alpha at `at_delay_s` are those of the discrete-time loop, which maps states and commands
    under way from one control period to the next. Otherwise the hold counts as half a period of delay, which is nearly
    the same at 50 Hz, but not at 5 Hz."""
    weight: tuple[Positive, Positive] | None = None
    """Weights of spacing errors and of velocity errors, the diagonal of W: every alpha then bounds disturbances by
    alpha |W e|. Omitted: W = I."""
