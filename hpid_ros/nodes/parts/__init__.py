"""What the executables are made of, one folder for each kind of node."""
