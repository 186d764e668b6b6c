"""The theory applied to the gains that somebody has: check them, upgrade them."""
