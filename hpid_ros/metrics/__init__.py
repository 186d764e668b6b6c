"""The indices of recordings: from bags to a comparison."""
