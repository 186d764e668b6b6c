"""The executables; a node is a shell around one pure object."""
