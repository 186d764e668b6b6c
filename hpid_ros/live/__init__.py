"""The live page: running controllers seen, retuned, tried and stopped by a person in a browser."""
