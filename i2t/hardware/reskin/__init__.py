"""A ReSkin or AnySkin board on a serial port."""
