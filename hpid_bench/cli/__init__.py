"""The command hpid: parse, call one function of a room, print."""
