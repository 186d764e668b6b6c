"""Benchmarks: each figure beside its limit or a peer from the same run.

``python -m benchmarks`` (or ``make bench``) from the checkout; ``--help`` says more.
"""
