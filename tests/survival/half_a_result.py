"""A sweep that is interrupted while a worker has sent but a part of its result."""

import signal
import sys
import time

from projservo_cli.sweeps.workers import Engine


def send_a_part(_):
    """Send the length of a result alone, as a process does that is ended amid it."""
    frame = sys._getframe()
    while "result_queue" not in frame.f_locals:
        frame = frame.f_back
    frame.f_locals["result_queue"]._writer._send(b"\x00\x00\x10\x00")
    time.sleep(600.0)


if __name__ == "__main__":
    signal.signal(signal.SIGALRM, lambda *_: sys.exit("interrupted"))
    signal.alarm(5)
    list(Engine(2).completed(send_a_part, [0]))
