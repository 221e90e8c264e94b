# SPDX-License-Identifier: GPL-3.0-or-later
"""What klippy does with time, threads, descriptors and children, each with the time that it takes by the clock."""
import multiprocessing
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
import time

began = time.monotonic()


def takes(name, seconds, call):
    """Calls, and checks how long it took. Each reading of the clock takes some nanoseconds, and Python before 3.9 has
    microseconds."""
    before = time.monotonic()
    result = call()
    took = time.monotonic() - before
    assert seconds - 0.00001 <= took < seconds + 0.001, f"{name}: {took} s instead of {seconds} s"
    print(f"{name}: {took:.3f} s, {result}")
    return result


def workers():
    jobs, done = queue.Queue(), []

    def work():
        while True:
            job = jobs.get()
            if job is None:
                return
            time.sleep(3)
            done.append(job)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for job in range(7):
        jobs.put(job)
        time.sleep(1)
    for _ in threads:
        jobs.put(None)
    for thread in threads:
        thread.join()
    return done


def signalled():
    condition, seen = threading.Condition(), []

    def waiter():
        with condition:
            condition.wait(60)
            seen.append(round(time.monotonic() - before))

    before = time.monotonic()
    threads = [threading.Thread(target=waiter) for _ in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(2)
    with condition:
        condition.notify()
    time.sleep(2)
    with condition:
        condition.notify_all()
    for thread in threads:
        thread.join()
    return seen


def piped(wait):
    """A descriptor that a thread makes ready after 5 s."""
    reader, writer = os.pipe()
    thread = threading.Timer(5, os.write, (writer, b"x"))
    thread.start()
    ready = wait(reader)
    thread.join()
    os.close(reader)
    os.close(writer)
    return ready


def polled(fd):
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return len(poll.poll(60000))


def epolled(fd):
    with select.epoll() as epoll:
        epoll.register(fd, select.EPOLLIN)
        return len(epoll.poll(60))


def computed(size):
    """A child that calculates as the input shaper's does, and sends more than a pipe holds."""
    ours, theirs = multiprocessing.Pipe()

    def calculate():
        theirs.send(sum(n * n for n in range(1000000)))
        theirs.send(b"x" * size)

    child = multiprocessing.get_context("fork").Process(target=calculate)
    child.start()
    waits = 0
    while child.is_alive() and not ours.poll():
        time.sleep(0.1)
        waits += 1
    result = ours.recv(), len(ours.recv())
    child.join()
    return waits, result


def counted():
    """Threads that compute side by side."""
    counts = []

    def count():
        number = 0
        while number < 100000:
            number += 1
        counts.append(number)

    threads = [threading.Thread(target=count) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return counts


def waited_for_clock():
    """A loop that reads the clock until a time."""
    until = time.monotonic() + 0.01
    while time.monotonic() < until:
        pass


def talked():
    """Two threads, and a socket between them."""
    near, far = socket.socketpair()
    near.setblocking(False)
    far.setblocking(False)

    def answer():
        for _ in range(5):
            select.select([far], [], [])
            time.sleep(1)
            far.send(far.recv(10).upper())

    thread = threading.Thread(target=answer)
    thread.start()
    answers = []
    for word in [b"a", b"b", b"c", b"d", b"e"]:
        near.send(word)
        select.select([near], [], [])
        answers.append(near.recv(10))
    thread.join()
    near.close()
    far.close()
    return b"".join(answers)


lock = threading.Lock()
lock.acquire()
takes("sleep", 100, lambda: time.sleep(100))
takes("workers", 9, workers)
takes("condition", 4, signalled)
takes("event", 50, lambda: threading.Event().wait(50))
takes("poll", 5, lambda: piped(polled))
takes("epoll", 5, lambda: piped(epolled))
takes("select", 5, lambda: piped(lambda fd: len(select.select([fd], [], [], 60)[0])))
takes("select of nothing", 7, lambda: select.select([], [], [], 7))
takes("lock", 9, lambda: lock.acquire(timeout=9))
takes("program", 0, lambda: subprocess.check_output(["sh", "-c", "echo one; sleep 0.3; echo two"]))
takes("program without output", 0, lambda: subprocess.call(["sleep", "0.1"]))
takes("small child", 0, lambda: computed(10))
takes("large child", 0, lambda: computed(1000000))
takes("threads that compute", 0, counted)
takes("loop", 0.01, waited_for_clock)
takes("socket", 5, talked)
signal.signal(signal.SIGALRM, lambda *_: print("signal"))
os.kill(os.getpid(), signal.SIGALRM)
takes("after a signal", 1, lambda: time.sleep(1))
wall = time.time()
time.sleep(3600)
assert 3600 <= time.time() - wall < 3600.001
print(f"all of it: {time.monotonic() - began:.6f} s")
sys.stdout.flush()
