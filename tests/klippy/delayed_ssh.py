#!/usr/bin/env python3
# SPDX-License-Identifier: GPL-3.0-or-later
"""Stands in for ssh: runs the command on this computer, and delays its bytes, in both directions.

delayed_ssh.py PINION ROUND_TRIP_MS JITTER_MS [ssh's options] -- HOST COMMAND

Each direction has half of ROUND_TRIP_MS, and up to JITTER_MS more. Bytes stay in order, as on TCP.
"""
import os, queue, random, subprocess, sys, threading, time

pinion, round_trip_ms, jitter_ms = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
command = sys.argv[sys.argv.index("--") + 2]
environment = dict(os.environ, PATH=os.path.dirname(pinion) + ":" + os.environ["PATH"])
child = subprocess.Popen(command, shell=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)


def carry(source, sink):
    waiting = queue.Queue()

    def write():
        while True:
            at, piece = waiting.get()
            time.sleep(max(0, at - time.monotonic()))
            if not piece:
                os.close(sink)
                return
            os.write(sink, piece)

    threading.Thread(target=write, daemon=True).start()
    piece = b"?"
    while piece:
        piece = os.read(source, 65536)
        delay_s = (round_trip_ms / 2 + random.uniform(0, jitter_ms)) / 1000
        waiting.put((time.monotonic() + delay_s, piece))


for source, sink in [(0, child.stdin.fileno()), (child.stdout.fileno(), 1)]:
    threading.Thread(target=carry, args=(source, sink), daemon=True).start()
sys.exit(child.wait())
