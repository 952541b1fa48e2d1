"""Sensors as parts: a vehicle lists what it carries, and its measurements, columns and effects follow.

Here live what sensors measure and how precisely. What may be wrong with them is an effect, and lives there.
"""

from steady_ppl.sensors.landmarks import Bearings, Ranges
from steady_ppl.sensors.on_board import BodyVelocity, Heading, Position, WheelSpeed, YawRate
from steady_ppl.sensors.sensor import Sensor

__all__ = ["Bearings", "BodyVelocity", "Heading", "Position", "Ranges", "Sensor", "WheelSpeed", "YawRate"]
