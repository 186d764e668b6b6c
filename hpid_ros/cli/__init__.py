"""The command ``hpid``."""
