"""``hpid metrics``: the indices of recordings, alone or compared."""
