"""Results in, pages out: what a run or a sweep found, in words, tables and pictures."""
