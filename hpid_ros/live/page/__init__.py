"""The page itself, by NiceGUI: the only importer of it."""
