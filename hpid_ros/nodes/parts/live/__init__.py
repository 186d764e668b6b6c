"""Processes that the command ``hpid`` starts beside a running graph."""
