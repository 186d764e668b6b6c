"""The subcommands of ``hpid``, one a file: arguments in, an exit code out."""

DONE, FAILED, BAD_INPUT, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141
"""Exit codes: done; something failed or is not certified; unusable input; interrupted; the
reader of the output went away."""
