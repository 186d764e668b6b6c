"""Rounding to significant digits."""


def significant(value: float, digits: int) -> float:
    """Return the number that a text of so many significant digits has."""
    return float(f"{value:.{digits}g}")
