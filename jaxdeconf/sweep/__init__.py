"""Many runs: a grid of configs and seeds; what points share is done once, models train together."""
