"""The errors that hpid_ros raises, one tree.

Every error is also the builtin that a caller would expect (``ValueError`` for a bad value,
``FileExistsError`` for a folder in the way), so that code that knows nothing of this package
can still catch it. Messages are one line: what came, what is allowed, which names exist.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from hpid_ros.base.text import LONGEST_NAME, bounded, name_text

_SHOWN_NAMES = 100
"""Names that exist, in a message."""
_COMPARED_NAMES = 10_000
_LONGEST_REASON = 1000  # characters
"""Names that exist, among which the nearest is looked for."""


def reason_of(error: Exception) -> str:
    """Return what an error says, in one line; of one that is not ours, its kind as well."""
    if isinstance(error, HpidError):
        return str(error)
    text = " ".join(str(error)[:_LONGEST_REASON].split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class HpidError(Exception):
    """Root of all errors of this package; its text is one line that can be printed anywhere."""

    def __str__(self) -> str:
        return bounded(super().__str__())


class GainError(HpidError, ValueError):
    """A set of gains that is not finite, not positive or does not stabilise the loop."""


class NormError(HpidError, ValueError):
    """A homogeneous norm that is not one: degree, weights or shape out of range."""


class SettingError(HpidError, ValueError):
    """A setting of a joint loop or a node that is out of range or unknown."""


class TrajectoryError(HpidError, ValueError):
    """A reference trajectory that cannot be followed."""


class EndedError(TrajectoryError):
    """A reference trajectory that has ended in the past."""


class RobotDescriptionError(HpidError, ValueError):
    """A URDF that cannot be read, or that lacks something that was asked of it."""


class ReachError(HpidError, ValueError):
    """A pose that a link cannot take within the joints' limits."""


class MessageError(HpidError, ValueError):
    """Bytes that are not the message they claim to be."""


class BagError(HpidError, ValueError):
    """A bag that cannot be read, or lacks the messages that were asked of it."""


class ExperimentError(HpidError, ValueError):
    """An experiment file with a missing, unknown or impossible entry."""


class ResultExistsError(HpidError, FileExistsError):
    """A result folder that is already there; nothing is overwritten unasked."""


class RunError(HpidError, RuntimeError):
    """A run of processes that failed or lost one of them."""


class LibraryError(HpidError, ImportError):
    """A library is not installed that this needs, and that others do without."""


class ClaimError(HpidError, RuntimeError):
    """A joint that another controller holds."""


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the line for a name that does not exist: nearest first, then those that do.

    Args:
        kind: What the name was meant to be, for instance ``"parameter"``.
        name: What came.
        known: The names that exist.
    """
    names = sorted(known)
    nearest = nearest_name(str(name), names)
    hint = f" did you mean {nearest!r}?" if nearest else ""
    return f"unknown {kind} {name_text(name)};{hint} known: {listed_names(names) or 'none'}"


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return the name that was probably meant; empty where none is like it, or they are many."""
    names = sorted(known)
    if len(name) > LONGEST_NAME or len(names) > _COMPARED_NAMES:
        return ""
    import difflib  # only a wrong name needs it

    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return nearest[0] if nearest else ""


def listed_names(names: Sequence[str], most: int = _SHOWN_NAMES) -> str:
    """Return names in a line, and how many more there are."""
    further = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + further


def require_known(
    kind: str, names: Iterable[str], known: Collection[str], error: type[HpidError] = SettingError
) -> None:
    """Refuse names that do not exist, the first of them as :func:`unknown_name` says it."""
    for name in names:
        if name not in known:
            raise error(unknown_name(kind, name, known))
