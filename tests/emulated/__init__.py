"""An emulated hobby arm: servos on a pseudo-terminal, and two cameras as streams on this machine.

The shaft angles are those of an arm in MuJoCo, whose servos lag, sag and have backlash. No emulator shows
V4L2, the wear of real gears, or glare.
"""
