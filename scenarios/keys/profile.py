"""A link profile: both directions of a radio link, shipped or measured, that scenarios name."""

from pydantic import BaseModel, Field

from scenarios.keys.link import Channel, Link
from scenarios.keys.part import NotNegative, Part


class ProfilePart(BaseModel):
    """Base of every part of a profile, as strict as a scenario, of which it is no part."""

    model_config = Part.model_config


class Latency(ProfilePart):
    """What was measured of one direction; all delays in s."""

    datagrams: int = Field(ge=0)
    """Datagrams whose one-way delay was measured."""
    delay_s_min: NotNegative
    """Least one-way delay (RFC 7679, section 5.3)."""
    delay_s_p50: NotNegative
    """Median one-way delay (RFC 7679, section 5.2)."""
    delay_s_p99: NotNegative
    """99th percentile of the one-way delay (RFC 7679, section 5.1)."""
    calibration_error_s: NotNegative
    """Largest error that the estimated clock brings into these delays (RFC 7679, section 3.7)."""
    variation_s_p99: NotNegative
    """99th percentile of the delay minus the least delay: PDV (RFC 5481, section 4.2)."""
    variation_next_s_p99: NotNegative
    """99th percentile of the difference between the delays of two datagrams in a row: IPDV (RFC 5481, section 4.1)."""
    lost: int = Field(ge=0)
    """Datagrams that sequence numbers show to be lost; 0 where that cannot be known."""
    loss_runs: int = Field(ge=0)
    """Losses in a row count as one run."""
    loss_run_longest: int = Field(ge=0)
    """Datagrams of the longest run."""


class Measured(ProfilePart):
    """What a profile was made from."""

    up: Latency
    """From vehicle to station."""
    down: Latency
    """From station to vehicle: TIMESYNC requests only, whose losses are not known."""


class LinkProfile(ProfilePart):
    """Both directions of a link, in place of `links.up`, `links.down` and `links.channels` of a scenario."""

    source: str
    """Where the figures are from."""
    licence: str
    """Under which terms they may be used."""
    up: Link
    """From each vehicle to the station."""
    down: Link
    """From the station to each vehicle."""
    channels: tuple[Channel, ...] = ()
    """Channels that these links use."""
    measured: Measured | None = None
    """The figures of a measured link."""
