"""Tables for terminals, programs and papers."""
