"""From a user's options to requests: what the command line and the notebook facade share.

Modules named after commands read their options as text, find what references name, and return
requests, or raise an error that names the option. They write to the session's console only; results
are printed elsewhere.
"""
