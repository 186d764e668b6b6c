"""The executables, with ``core`` for all of them and ``parts`` for one kind."""
