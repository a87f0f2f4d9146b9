"""Many things: a table that is emptied into a bin, one pick after the other."""
