"""The command line: a class for each command, related ones in one thin module.

tyro shows the text beneath an option, or the comment behind it, as its help.
"""
