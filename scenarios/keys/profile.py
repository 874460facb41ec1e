"""Link profiles that scenarios name: both directions of a radio link, shipped or measured."""

from pydantic import BaseModel, Field

from scenarios.keys.link import Channel, Link
from scenarios.keys.part import NotNegative, Part


class ProfilePart(BaseModel):
    """Base of every part of a profile: as strict as a part of a scenario, but not one."""

    model_config = Part.model_config


class Latency(ProfilePart):
    """Measurements of one direction; all delays in s."""

    datagrams: int = Field(ge=0)
    """Datagrams whose one-way delay was measured."""
    delay_s_min: NotNegative
    """Least one-way delay (RFC 7679, section 5.3)."""
    delay_s_p50: NotNegative
    """Median one-way delay (RFC 7679, section 5.2)."""
    delay_s_p99: NotNegative
    """99th percentile of the one-way delay (RFC 7679, section 5.1)."""
    calibration_error_s: NotNegative
    """Largest error of these delays due to the estimated clock (RFC 7679, section 3.7)."""
    variation_s_p99: NotNegative
    """99th percentile of the delay minus the least delay: PDV (RFC 5481, section 4.2)."""
    variation_next_s_p99: NotNegative
    """99th percentile of the difference between the delays of successive datagrams: IPDV (RFC 5481, section 4.1)."""
    lost: int = Field(ge=0)
    """Datagrams that sequence numbers show to be lost; 0 where that cannot be known."""
    loss_runs: int = Field(ge=0)
    """Number of runs of loss; successive losses are one run."""
    loss_run_longest: int = Field(ge=0)
    """Number of datagrams in the longest run."""


class Measured(ProfilePart):
    """The measurements that a profile was made from."""

    up: Latency
    """From vehicle to station."""
    down: Latency
    """From station to vehicle: TIMESYNC requests only, whose losses are not known."""


class LinkProfile(ProfilePart):
    """Both directions of a link, in place of `links.up`, `links.down` and `links.channels` of a scenario."""

    source: str
    """Source of the figures."""
    licence: str
    """Terms under which the figures may be used."""
    up: Link
    """From each vehicle to the station."""
    down: Link
    """From the station to each vehicle."""
    channels: tuple[Channel, ...] = ()
    """Channels that these links use."""
    measured: Measured | None = None
    """The figures of a measured link."""
