"""How many examples a property is tried with, beside those of the others."""

from hypothesis import settings


def examples(share, **others):
    """Return settings with a share of the examples of the profile in force.

    Args:
        share: Above 1 for what is cheap and has many corners, below for what takes long.
        others: Further settings.
    """
    return settings(max_examples=max(1, round(share * settings().max_examples)), **others)
