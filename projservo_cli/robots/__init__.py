"""Robots of the contract: true ones and rigs, simulated ones, and those of users."""
