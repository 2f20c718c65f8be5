"""Imagine2touch as its authors wrote it: the network, the loss, the ensemble's rules, the recognition loop, the
classifier of stamps; nothing else.

Source: Ayad et al., "Imagine2touch: Predictive Tactile Sensing for Robotic Manipulation using Efficient Low-Dimensional
Signals", and its published code (github.com/ayadabdalla/imagine2touch) where the text is silent.
"""
