"""One run, kept and resumed: config, stages, store, judgement, results."""
