"""Parts of the joint controller."""
