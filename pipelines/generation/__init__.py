"""Ray graphs that sample, inpaint, outpaint and edit scenes."""
