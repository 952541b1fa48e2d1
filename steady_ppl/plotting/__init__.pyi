from .check import innovations as innovations
from .comparison import open_loop_picture as open_loop_picture
from .discovery import unknown_effect as unknown_effect
from .fit import (
    effective_sizes as effective_sizes,
    forecast_band as forecast_band,
    held_out_curve as held_out_curve,
    observation_noise as observation_noise,
    particle_curve as particle_curve,
    posterior_states as posterior_states,
    posterior_trajectories as posterior_trajectories,
    posterior_velocities as posterior_velocities,
)
