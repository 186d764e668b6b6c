"""Parts of the merger's node: parameters, output, receiver, health."""
