"""Robots of the contract: true ones and rigs, simulated ones, and robots of users."""
