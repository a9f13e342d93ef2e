"""The activations that settings may name, as torch modules; rewards and policies share them."""

from torch import nn

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}
