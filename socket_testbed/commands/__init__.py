"""The verbs of the command line: each is a function, whose signature gives its options."""
