"""The subcommands of ``hpid``, one a file: arguments in, an exit code out."""

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done; something failed or is not certified; unusable input; interrupted."""
