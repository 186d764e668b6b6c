"""The settings of a joint loop: the table of its parameters, and the records made of them."""
