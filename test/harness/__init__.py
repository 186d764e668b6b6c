"""Parts that tests share: a graph to talk to, bags to read, faults to inject."""
