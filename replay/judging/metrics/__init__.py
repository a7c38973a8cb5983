"""Makes metrics of errors: the numbers of all that is judged; begin with `measuring`."""
