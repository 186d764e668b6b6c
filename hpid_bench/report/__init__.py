"""Tables, figures, the page of a result, margins, and animations."""
