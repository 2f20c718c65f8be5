"""Force of a collision, and fastest allowed motion.

A tool that meets something at a speed v goes on for the time t in which nothing has been told to brake, and then brakes
with a: it stops after

    d = v t + v^2 / 2 a,

the sum of the way in the reaction time and the braking distance, as ISO 13855:2010 sums them up for separation from a
machine. The contact is a spring of k N/m (skin, arm and mount in series), and the arm is position-controlled, so that
the spring does not slow it down; from the force at which the stop is triggered to the end come k d newtons more. So the
fastest motion that stops within a force f more is the positive root of k (v t + v^2 / 2 a) = f,

    v = a (sqrt(t^2 + 2 f / (k a)) - t).

The reaction time of a UR arm behind ur_rtde is 40 ms: 8 ms for a state at 125 Hz, 10 ms for the next look, and some
20 ms until a command has been carried out. Metres, seconds, newtons; arithmetic alone.
"""

import math

REACTION_S = 0.04  # from the force to the brake


def overrun_force(speed: float, stiffness: float, *, braking: float, delay: float = REACTION_S) -> float:
    """Force that a contact gains until the tool stands.

    Args:
        speed: m/s, at first contact or when it is told to stop.
        stiffness: N/m, of the contact.
        braking: m/s^2.
        delay: s, until it brakes.

    Returns:
        N.
    """
    return stiffness * (speed * delay + speed**2 / (2 * braking))


def fastest_speed(force: float, stiffness: float, *, braking: float, delay: float = REACTION_S) -> float:
    """The fastest speed at which a contact gains no more than a force until the tool stands.

    Args:
        force: N, that may come.
        stiffness: N/m, of the contact.
        braking: m/s^2.
        delay: s, until it brakes.

    Returns:
        m/s; 0 where no force may come.
    """
    return braking * (math.sqrt(delay**2 + 2 * max(0.0, force) / (stiffness * braking)) - delay)
