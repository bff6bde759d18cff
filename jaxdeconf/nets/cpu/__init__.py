"""Operations that XLA's CPU backend is slow at: same arguments and numbers, other algorithms."""

from jaxdeconf.nets.cpu.conv import conv_general_dilated
from jaxdeconf.nets.cpu.pool import max_pool

__all__ = ["conv_general_dilated", "max_pool"]
