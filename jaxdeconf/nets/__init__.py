"""Networks: the β-VAE and the pre-activation ResNet-18, on images of any size."""
