"""Sensors as parts: a vehicle lists what it carries, and its measurements, columns and effects follow.

Here live what sensors measure and how precisely. What may be wrong with them is an effect, and lives there.
"""

from steady_ppl.sensors.landmarks import Bearings, Ranges, RangesBearings
from steady_ppl.sensors.on_board import Accelerometer, BodyVelocity, Heading, Pose, Position, YawRate
from steady_ppl.sensors.sensor import Sensor, Several
from steady_ppl.sensors.wheels import Encoder, WheelSpeed

__all__ = ["Accelerometer", "Bearings", "BodyVelocity", "Encoder", "Heading", "Pose", "Position", "Ranges"]
__all__ += ["RangesBearings", "Sensor", "Several", "WheelSpeed", "YawRate"]
