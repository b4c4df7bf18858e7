"""The command: one module a verb, named after it, with its options and what it does.

`options` has the options that several verbs share, `help` the pages and the list of verbs, `main`
the program and its exit codes. A verb imports what takes long when it runs.
"""
