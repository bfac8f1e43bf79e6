"""Edit and repair single scenes."""
