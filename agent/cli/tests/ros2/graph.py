"""A node of rclpy with an action server and client, and a service server in a namespace."""

import rclpy
from example_interfaces.action import Fibonacci
from example_interfaces.srv import AddTwoInts
from rclpy.action import ActionClient, ActionServer

rclpy.init()
server = rclpy.create_node('server', namespace='/robot1')
client = rclpy.create_node('client')
action = ActionServer(server, Fibonacci, '/fibonacci', lambda goal: Fibonacci.Result())
service = server.create_service(AddTwoInts, 'add', lambda request, response: response)
goals = ActionClient(client, Fibonacci, '/fibonacci')
calls = client.create_client(AddTwoInts, '/robot1/add')
executor = rclpy.executors.SingleThreadedExecutor()
executor.add_node(server)
executor.add_node(client)
print('ready', flush=True)
executor.spin()
