"""The indices of any sampled signal, without a bag: here a step response with noise."""

import numpy as np

from hpid_ros.metrics.indices import integral_of_absolute, itae, l2_norm, total_variation

time = np.arange(0.0, 9.0, 0.001)  # [s]
error = 0.3 * np.exp(-2.0 * time) * np.cos(3.0 * time)  # [rad]
noise = np.random.default_rng(1).normal(0.0, 0.01, time.size)
effort = 5.0 * error + noise  # [N m]

print(f"IVC   {total_variation(effort):8.3f} N m")
print(f"IAVC  {integral_of_absolute(time, effort):8.3f} N m s")
print(f"ITAE  {itae(time, error):8.4f} rad s^2")
print(f"||u|| {l2_norm(time, effort):8.3f} N m s^0.5")
print(f"||e|| {l2_norm(time, error):8.4f} rad s^0.5")
