"""The hovercraft among landmarks that nobody has surveyed."""

from steady_ppl import UnknownMap

from .hovercraft import HovercraftTruth
from .neural_vehicle import NeuralHovercraft


class HovercraftUnknownMap(UnknownMap, HovercraftTruth):
    """Drag, mass and the places of the landmarks are learned together, from known starts."""

    rates = {**HovercraftTruth.rates, "map": 3.0}


class NeuralHovercraftUnknownMap(UnknownMap, NeuralHovercraft):
    """The same with a network for the dynamics."""

    rates = {**NeuralHovercraft.rates, "map": 3.0}
