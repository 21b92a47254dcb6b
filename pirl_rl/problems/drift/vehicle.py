"""Tyres and planar motion of a rear-driven car, shared by the drifting problems.

Fiala's brush model (Hindiyeh and Gerdes, J. Dyn. Sys. Meas. Control 136, 2014): with z = tan(alpha), C the cornering
stiffness and D = n mu F_z the lateral force at full sliding, n what the drive force leaves of the friction circle,

    F_y = C z - C^2 |z| z / (3 D) + C^3 z^3 / (27 D^2)   where |z| < 3 D / C,   else D sign(alpha).

A positive slip angle gives a positive force. SI units; all arguments broadcast.
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
LEAST_SPEED = 1e-3  # m/s; slip angles are those of this longitudinal speed below it
FRICTION_CIRCLE = 0.999  # share of mu F_zr that the drive force may take


def fiala(z: Tensor, sign: Tensor, stiffness: float, sliding: Tensor) -> Tensor:
    """Lateral tyre force, N.

    Args:
        z: tangent of the slip angle.
        sign: sign of the slip angle, which its tangent loses beyond 90 degrees.
        stiffness: C, N/rad.
        sliding: D, N.
    """
    # With q = C |z| / (3 D), in [0, 1] where the tyre grips, the polynomial is 3 q - 3 q^2 + q^3 = 1 - (1 - q)^3.
    grip = stiffness / 3 * z.abs() / sliding
    return torch.where(grip < 1, z.sign(), sign) * sliding * (1 - (1 - grip).clamp(min=0) ** 3)


def front_force(v_x: Tensor, v_y: Tensor, r: Tensor, tan_delta: Tensor, friction: Tensor) -> Tensor:
    """F_yf at the slip angle delta - atan2(v_y + a r, v_x), by the tangent's addition theorem; v_x > 0."""
    t = (v_y + FRONT_ARM * r) / v_x
    slip = tan_delta - t
    return fiala(slip / (1 + tan_delta * t), slip.sign(), FRONT_STIFFNESS, friction * FRONT_LOAD)


def rear_force(v_x: Tensor, v_y: Tensor, r: Tensor, friction: Tensor, drive: Tensor) -> Tensor:
    """F_yr at the slip angle -atan2(v_y - b r, v_x) beside a drive force; v_x > 0."""
    z = (REAR_ARM * r - v_y) / v_x
    # n mu F_zr, n = sqrt((mu F_zr)^2 - F_x^2) / (mu F_zr).
    sliding = ((friction * REAR_LOAD) ** 2 - drive**2).sqrt()
    return fiala(z, z.sign(), REAR_STIFFNESS, sliding)


def accelerations(
    v_x: Tensor, v_y: Tensor, r: Tensor, delta: Tensor, friction: Tensor, demand: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """v_x', v_y' (m/s^2) and r' (rad/s^2) of the single-track model at a demanded drive force (N); v_x > 0."""
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
    """The part of a demanded F_x that the rear tyres transmit, |F_x| <= 0.999 mu F_zr."""
    limit = FRICTION_CIRCLE * REAR_LOAD * friction
    return torch.minimum(torch.maximum(demand, -limit), limit)
