"""The graph of running controllers, as a page in a browser asks for it."""
