"""Log lines on standard error, and the options that choose them."""
