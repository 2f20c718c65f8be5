"""How well is what a recording does not say found in it?"""
