"""How many examples a property is tried with, beside those of the others."""

from hypothesis import settings


def examples(share, **others):
    """Return settings with a share of the active profile's examples: above 1 for what is cheap."""
    return settings(max_examples=max(1, round(share * settings().max_examples)), **others)
