"""Parts of the action server: parameters, messages, goals of clients, health."""
