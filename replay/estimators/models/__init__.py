"""Models systems for every recursive method, one file each; begin with `landmarks`."""
