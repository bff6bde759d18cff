"""How a system looks: the differentiable rasteriser and the nuisances drawn with it."""
