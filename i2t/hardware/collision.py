"""Force of a collision, and the highest speed that keeps it within a limit.

A tool that meets something at a speed v moves on for the reaction time t and then brakes with a deceleration a. It
stops after

    d = v t + v^2 / 2 a,

the sum of the reaction distance and the braking distance (as in ISO 13855:2010, on the separation from a machine). The
contact is a spring of k N/m: skin, arm and mount in series. The arm is position-controlled, so the spring does not slow
it down, and the force grows by k d between the trigger of the stop and the end. The highest speed at which the force
grows by no more than f is therefore the positive root of k (v t + v^2 / 2 a) = f,

    v = a (sqrt(t^2 + 2 f / (k a)) - t).

The reaction time of a UR arm behind ur_rtde is 40 ms: 8 ms for a state at 125 Hz, 10 ms until the next poll, and about
20 ms until the command has been carried out. Metres, seconds, newtons; plain arithmetic.
"""

import math

from i2t.hardware.limits import SAFETY


def overrun_force(speed: float, stiffness: float, *, braking: float, delay: float = SAFETY.reaction_time_s) -> float:
    """Calculate by how much the force of a contact grows until a moving tool has braked to a stop.

    Args:
        speed: Speed in m/s at first contact, or when a stop is commanded.
        stiffness: Stiffness of the contact in N/m.
        braking: Deceleration in m/s^2.
        delay: Time in s until the tool begins to brake.

    Returns:
        The growth of the force in N.
    """
    return stiffness * (speed * delay + speed**2 / (2 * braking))


def fastest_speed(force: float, stiffness: float, *, braking: float, delay: float = SAFETY.reaction_time_s) -> float:
    """Calculate the highest speed at which the force of a contact grows by at most a given value until the tool stands.

    Args:
        force: Largest allowed growth of the force in N.
        stiffness: Stiffness of the contact in N/m.
        braking: Deceleration in m/s^2.
        delay: Time in s until the tool begins to brake.

    Returns:
        The speed in m/s; 0 if no growth is allowed.
    """
    return braking * (math.sqrt(delay**2 + 2 * max(0.0, force) / (stiffness * braking)) - delay)
