"""A client and a server of real ROS 2 services and of an action, and what the client logs.

    services.py serve LOG       answers /add after some milliseconds, never answers /hang,
                                executes goals of /fib
    services.py call LOG COUNT  waits for the server, then follows lines on standard input:
                                `add` calls /add COUNT times, `hang` calls /hang once,
                                `lose` calls /add, which takes 1.5 s, without waiting, `goal`
                                sends a goal and waits for its result, `end` ends it

Both print `ready`, and the client prints `done` after each line. The client's log has one line of
JSON for each call. `began` is the time at which the function that sends the request was called.
`received` is the time at which the middleware received the response, or at which the response was
taken, if the middleware does not report it. The server's log has one line for each answer of /add.
`received` is the time at which the request was received, or at which its callback began. `sent` is
the time at which the function that sends the response was called. Both processes have real-time
priority, so that other programs do not delay the logged events.
"""

import json
import os
import sys
import threading
import time

import rclpy
from example_interfaces.action import Fibonacci
from example_interfaces.srv import AddTwoInts
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from std_srvs.srv import Trigger

# Steps of a goal, in seconds.
STEPS = 3
STEP = 0.2


def say(word):
    print(word, flush=True)


# Time at which the thread's callback began.
callback = threading.local()


def add(request, response):
    callback.began = time.time_ns()
    time.sleep(request.a * 1e-3)
    response.sum = request.a + request.b
    return response


def hang(_request, response):
    threading.Event().wait()
    return response


def execute(goal):
    for _ in range(STEPS):
        time.sleep(STEP)
    goal.succeed()
    return Fibonacci.Result(sequence=[0, 1])


def log_answers(service, file):
    send = service.send_response

    def send_and_log(response, header):
        sent = time.time_ns()
        send(response, header)
        # Cyclone DDS does not report when it received a request.
        line = {"received": header.received_timestamp or callback.began, "sent": sent}
        file.write(json.dumps(line) + "\n")

    service.send_response = send_and_log


def serve(log):
    node = rclpy.create_node("server")
    group = ReentrantCallbackGroup()
    adder = node.create_service(AddTwoInts, "add", add, callback_group=group)
    log_answers(adder, open(log, "w", buffering=1))
    node.create_service(Trigger, "hang", hang, callback_group=group)
    server = ActionServer(node, Fibonacci, "fib", execute, callback_group=group)
    say("ready")
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    executor.spin()
    server.destroy()


class Client:
    def __init__(self, log, count):
        self.file = open(log, "w", buffering=1)
        self.count = count
        self.node = rclpy.create_node("client")
        self.adder = self.node.create_client(AddTwoInts, "add")
        self.hanger = self.node.create_client(Trigger, "hang")
        self.action = ActionClient(self.node, Fibonacci, "fib")
        self.adder.wait_for_service()
        self.hanger.wait_for_service()
        self.action.wait_for_server()
        # The agent and the endpoints at the other end need some time.
        time.sleep(1.0)

    def call(self, milliseconds):
        """Calls /add, and takes the response as soon as the middleware has it."""
        handle = self.adder.handle
        request = AddTwoInts.Request(a=milliseconds, b=1)
        with handle:
            began = time.time_ns()
            handle.send_request(request)
            while True:
                header, response = handle.take_response(AddTwoInts.Response)
                taken = time.time_ns()
                if response is not None:
                    break
                time.sleep(0.000_002)
        assert response.sum == milliseconds + 1
        # Cyclone DDS does not report when it received a response.
        self.write({"began": began, "received": header.received_timestamp or taken})

    def write(self, line):
        self.file.write(json.dumps(line) + "\n")

    def add(self):
        for number in range(self.count):
            self.call(number % 9)

    def hang(self):
        self.hanger.call_async(Trigger.Request())

    def lose(self):
        with self.adder.handle:
            self.adder.handle.send_request(AddTwoInts.Request(a=1500, b=1))

    def goal(self):
        began = time.time_ns()
        accepted = self.action.send_goal_async(Fibonacci.Goal(order=5))
        rclpy.spin_until_future_complete(self.node, accepted)
        result = accepted.result().get_result_async()
        rclpy.spin_until_future_complete(self.node, result)
        self.write({"goal": True, "began": began, "received": time.time_ns()})


def call(log, count):
    client = Client(log, int(count))
    # The threads of the middleware have a higher priority than this one, which polls.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    say("ready")
    for line in sys.stdin:
        if line.strip() == "end":
            break
        getattr(client, line.strip())()
        say("done")


if __name__ == "__main__":
    # The threads of the middleware inherit it.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    rclpy.init()
    {"serve": serve, "call": call}[sys.argv[1]](*sys.argv[2:])
