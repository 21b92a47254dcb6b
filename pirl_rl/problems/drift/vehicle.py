"""Tyres and planar motion of a rear-driven car, shared by the drifting problems.

The lateral tyre force follows Fiala's brush model (Hindiyeh and Gerdes, J. Dyn. Sys. Meas. Control 136, 2014),

    F_y = C z - C^2 |z| z / (3 D) + C^3 z^3 / (27 D^2)   where |z| < 3 D / C,   else D sign(alpha),

with the slip angle alpha, z = tan(alpha), the cornering stiffness C, and the lateral force D = n mu F_z of a tyre that
slides fully, where n <= 1 is the share of the friction circle that the drive force leaves. A positive slip angle gives
a positive force. All quantities are in SI units, and all arguments broadcast.
"""

from __future__ import annotations

import torch
from torch import Tensor

MASS = 1724.0  # kg
YAW_INERTIA = 1300.0  # kg m^2
FRONT_ARM, REAR_ARM = 1.35, 1.15  # m, from the center of gravity to the axles
FRONT_STIFFNESS, REAR_STIFFNESS = 120_000.0, 175_000.0  # N/rad
GRAVITY = 9.81  # m/s^2
FRONT_LOAD = MASS * GRAVITY * REAR_ARM / (FRONT_ARM + REAR_ARM)  # N, static
REAR_LOAD = MASS * GRAVITY * FRONT_ARM / (FRONT_ARM + REAR_ARM)
LEAST_SPEED = 1e-3  # m/s; v_x is clamped to it, since slip angles divide by v_x
FRICTION_CIRCLE = 0.999  # share of mu F_zr that the drive force may take


def fiala(z: Tensor, sign: Tensor, stiffness: float, sliding: Tensor) -> Tensor:
    """The lateral tyre force F_y, in N.

    Args:
        z: tangent of the slip angle.
        sign: sign of the slip angle, which differs from that of `z` beyond 90 degrees.
        stiffness: C, in N/rad.
        sliding: D, in N.
    """
    # With q = C |z| / (3 D), in [0, 1] where the tyre grips, the polynomial is 3 q - 3 q^2 + q^3 = 1 - (1 - q)^3.
    grip = stiffness / 3 * z.abs() / sliding
    return torch.where(grip < 1, z.sign(), sign) * sliding * (1 - (1 - grip).clamp(min=0) ** 3)


def front_force(v_x: Tensor, v_y: Tensor, r: Tensor, tan_delta: Tensor, friction: Tensor) -> Tensor:
    """F_yf, in N, at the slip angle delta - atan2(v_y + a r, v_x), whose tangent is a difference formula; v_x > 0."""
    t = (v_y + FRONT_ARM * r) / v_x
    slip = tan_delta - t
    return fiala(slip / (1 + tan_delta * t), slip.sign(), FRONT_STIFFNESS, friction * FRONT_LOAD)


def rear_force(v_x: Tensor, v_y: Tensor, r: Tensor, friction: Tensor, drive: Tensor) -> Tensor:
    """F_yr, in N, at the slip angle -atan2(v_y - b r, v_x) and the drive force `drive` (N); v_x > 0."""
    z = (REAR_ARM * r - v_y) / v_x
    # D = n mu F_zr with n = sqrt((mu F_zr)^2 - F_x^2) / (mu F_zr).
    sliding = ((friction * REAR_LOAD) ** 2 - drive**2).sqrt()
    return fiala(z, z.sign(), REAR_STIFFNESS, sliding)


def accelerations(
    v_x: Tensor, v_y: Tensor, r: Tensor, delta: Tensor, friction: Tensor, demand: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """v_x', v_y' (m/s^2) and r' (rad/s^2) of the single-track model; `demand` is the demanded F_x (N), v_x > 0."""
    drive = drive_force(demand, friction)
    sin, cos = delta.sin(), delta.cos()
    front = front_force(v_x, v_y, r, sin / cos, friction)
    rear = rear_force(v_x, v_y, r, friction, drive)
    return (
        (drive - front * sin) / MASS + v_y * r,
        (rear + front * cos) / MASS - v_x * r,
        (FRONT_ARM * front * cos - REAR_ARM * rear) / YAW_INERTIA,
    )


def drive_force(demand: Tensor, friction: Tensor) -> Tensor:
    """The drive force F_x, in N, that the rear tyres transmit: the demanded one, limited to |F_x| <= 0.999 mu F_zr."""
    limit = FRICTION_CIRCLE * REAR_LOAD * friction
    return torch.minimum(torch.maximum(demand, -limit), limit)
