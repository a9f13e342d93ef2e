"""From a user's options to requests: what the command line and the notebook facade share.

Each module has the function of one command. It reads options as text, finds what references name,
and returns a request, or raises an error that names the option. It prints nothing.
"""
