"""The command line: a class for each command, related ones in one thin module."""
