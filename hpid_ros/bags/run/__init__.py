"""A run out of a bag: which topics, which references, joint by joint."""
