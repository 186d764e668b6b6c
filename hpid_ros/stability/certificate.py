"""Certificates of stability as plain data: what was found, so that anyone can check it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control.gains import Gains
from hpid_ros.control.norms import CanonicalNorm, WeightedNorm
from hpid_ros.stability.closed_loop import Norm

Matrix = tuple[tuple[float, ...], ...]

FORMAT = "hpid_ros certificate 1"


@dataclass(frozen=True)
class CertifiedSpan:
    """One P that certifies a loop at several neighbouring degrees."""

    inertia: float  # [kg m^2] what one unit of effort accelerates
    # the law's norm at each degree, from the span's lower end to its upper one
    norms: tuple[Norm, ...]
    # [rad] the symmetric 3x3 matrix P on (e, de/dt [rad/s], (p - I)/inertia [rad/s^2])
    shape: Matrix
    rate: float  # [1/s] how fast the field enters the sphere x'Px = 1 where it does so slowest

    @property
    def lower(self) -> float:
        """The least degree."""
        return self.norms[0].degree

    @property
    def upper(self) -> float:
        """The largest degree."""
        return self.norms[-1].degree


@dataclass(frozen=True)
class Certificate:
    """That a loop is stable in an interval of degrees, with all that is needed to check it."""

    gains: Gains  # gains of the loop
    spans: tuple[CertifiedSpan, ...]  # the spans, in order of inertia, then of degree

    def __post_init__(self) -> None:
        if not self.spans:
            raise SettingError("a certificate must hold at least one span of degrees, not none")
        for span in self.spans:
            degrees = [norm.degree for norm in span.norms]
            if not degrees or degrees != sorted(set(degrees)):
                raise SettingError(f"the degrees of a span must rise, not be {degrees}")
        for before, after in zip(self.spans, self.spans[1:], strict=False):
            if before.inertia == after.inertia and before.upper != after.lower:
                raise SettingError(
                    f"the spans of a certificate must follow each other, not end at "
                    f"{before.upper:g} and begin at {after.lower:g}"
                )

    @property
    def inertias(self) -> tuple[float, ...]:
        """The inertias that were certified, in [kg m^2]."""
        return tuple(sorted({span.inertia for span in self.spans}))

    @property
    def lower(self) -> float:
        """The least degree that is certified for every inertia."""
        return max(
            min(span.lower for span in self.spans if span.inertia == inertia)
            for inertia in self.inertias
        )

    @property
    def upper(self) -> float:
        """The largest degree that is certified for every inertia."""
        return min(
            max(span.upper for span in self.spans if span.inertia == inertia)
            for inertia in self.inertias
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return what JSON can hold."""
        return {
            "format": FORMAT,
            "gains": {"p": self.gains.p, "i": self.gains.i, "d": self.gains.d},
            "spans": [
                {
                    "inertia": span.inertia,
                    "rate": span.rate,
                    "shape": [list(row) for row in span.shape],
                    "norms": [_norm_to_mapping(norm) for norm in span.norms],
                }
                for span in self.spans
            ],
        }

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Certificate:
        """Return the certificate that :meth:`to_mapping` gave."""
        if not isinstance(mapping, Mapping) or mapping.get("format") != FORMAT:
            raise SettingError(f"a certificate's format must be {FORMAT!r}")
        try:
            gains = Gains(*(float(mapping["gains"][term]) for term in "pid"))
            spans = tuple(
                CertifiedSpan(
                    inertia=float(span["inertia"]),
                    norms=tuple(_norm_from_mapping(norm) for norm in span["norms"]),
                    shape=tuple(tuple(float(x) for x in row) for row in span["shape"]),
                    rate=float(span["rate"]),
                )
                for span in mapping["spans"]
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, HpidError):
                raise
            raise SettingError(f"a certificate lacks or misshapes an entry: {error!r}") from None
        return cls(gains, spans)


class DegreeInterval(NamedTuple):
    """Degrees at which a loop is certified stable."""

    lower: float  # the least one, not above 0
    upper: float  # the largest one, not below 0
    certificate: Certificate  # what proves it

    def contains(self, degree: float) -> bool:
        """Tell whether a degree is certified."""
        return self.lower <= degree <= self.upper


def _norm_to_mapping(norm: Norm) -> dict[str, Any]:
    if isinstance(norm, WeightedNorm):
        return {
            "type": "weighted",
            "degree": norm.degree,
            "error_weight": norm.error_weight,
            "rate_weight": norm.rate_weight,
        }
    if isinstance(norm, CanonicalNorm):
        shape = [list(row) for row in norm.shape]
        return {"type": "canonical", "degree": norm.degree, "shape": shape}
    raise SettingError(f"a certificate of a {type(norm).__name__} cannot be saved")


def _norm_from_mapping(mapping: Mapping[str, Any]) -> Norm:
    if mapping["type"] == "weighted":
        return WeightedNorm(mapping["degree"], mapping["error_weight"], mapping["rate_weight"])
    if mapping["type"] == "canonical":
        return CanonicalNorm(mapping["degree"], mapping["shape"])
    raise SettingError(f"a norm must be weighted or canonical, not {mapping['type']!r}")
