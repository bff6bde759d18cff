"""The command line: flags and exit codes; alone knows a run, a sweep and their reports."""
