"""Version of the package, readable without importing the package's public face."""

__version__ = "0.2.0"
