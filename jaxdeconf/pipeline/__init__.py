"""The flow of an experiment; the only place that writes to disk or prints."""
