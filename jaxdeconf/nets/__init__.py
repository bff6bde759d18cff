"""Networks: a convolution that is fast on a CPU, the β-VAE and the pre-activation ResNet-18."""
