"""Magnetic skin: contact of the elastic layer, field of its magnets, pads and their boards, noise of the sensor."""
