"""Parts of every node: executor, parameters, qualities of service."""
