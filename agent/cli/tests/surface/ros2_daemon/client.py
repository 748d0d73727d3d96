"""Calls every function of the ros2 daemon as a distribution's command line would.

The classes replace those of rclpy. As in ros2cli, each class is registered only for its element,
and its constructor accepts only its own fields, so an answer of another distribution raises an
exception. Each answer is encoded again from its objects, and must have the same bytes. Prints a
JSON object.

Usage: client.py PORT DISTRIBUTION
"""

import json
import sys
import xmlrpc.client

port, distro = int(sys.argv[1]), sys.argv[2]
is_lyrical = distro == 'lyrical'
endpoint_module = 'rclpy.endpoint_info' if is_lyrical else 'rclpy.topic_endpoint_info'
enum_name = 'EndpointTypeEnum' if is_lyrical else 'TopicEndpointTypeEnum'
bodies = []


class Number:
    """An enumeration or a duration: one number."""

    def __init__(self, data):
        self.number = int(data)

    def shown(self):
        return self.number


class Fields:
    """An object with exactly these fields."""

    names = ()

    def __init__(self, **fields):
        assert tuple(fields) == self.names, (type(self), tuple(fields))
        self.fields = fields

    def shown(self):
        return {name: shown(value) for name, value in self.fields.items()}


def shown(value):
    if hasattr(value, 'shown'):
        return value.shown()
    if isinstance(value, xmlrpc.client.Binary):
        return value.data.hex()
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, list):
        return [shown(each) for each in value]
    return value


def number(tag):
    kind = type(tag.rsplit('.', 1)[1], (Number,), {})

    def end(unmarshaller, data):
        unmarshaller.append(kind(data))
        unmarshaller._value = 0

    def dump(marshaller, value, write):
        write(f'<value><{tag}>{value.number}</{tag}></value>')

    xmlrpc.client.Unmarshaller.dispatch[tag] = end
    xmlrpc.client.Marshaller.dispatch[kind] = dump


def fields(tag, *names):
    kind = type(tag.rsplit('.', 1)[1], (Fields,), {'names': names})

    def end(unmarshaller, data):
        unmarshaller._stack[-1] = kind(**unmarshaller._stack[-1])
        unmarshaller._value = 0

    def dump(marshaller, value, write):
        write(f'<value><{tag}>')
        marshaller.dump_struct(value.fields, write)
        write(f'</{tag}></value>')

    xmlrpc.client.Unmarshaller.dispatch[tag] = end
    xmlrpc.client.Marshaller.dispatch[kind] = dump


for name in ('HistoryPolicy', 'ReliabilityPolicy', 'DurabilityPolicy', 'LivelinessPolicy'):
    number(f'rclpy.qos.{name}')
number('rclpy.duration.Duration')
number(f'{endpoint_module}.{enum_name}')
fields('rclpy.qos.QoSProfile', 'history', 'depth', 'reliability', 'durability', 'lifespan',
       'deadline', 'liveliness', 'liveliness_lease_duration', 'avoid_ros_namespace_conventions')
hash_field = () if distro == 'humble' else ('topic_type_hash',)
fields(f'{endpoint_module}.TopicEndpointInfo', 'node_name', 'node_namespace', 'topic_type',
       *hash_field, 'endpoint_type', 'endpoint_gid', 'qos_profile')
if distro != 'humble':
    fields('rclpy.type_hash.TypeHash', 'version', 'value')
if is_lyrical:
    fields(f'{endpoint_module}.ServiceEndpointInfo', 'node_name', 'node_namespace',
           'service_type', 'service_type_hash', 'qos_profiles', 'endpoint_gids', 'endpoint_type',
           'endpoint_count')
    fields(f'{endpoint_module}.ActionEndpointInfo', 'goal_service_info', 'cancel_service_info',
           'result_service_info', 'feedback_topic_info', 'status_topic_info')


class Transport(xmlrpc.client.Transport):
    """A transport that keeps the bytes of each answer."""

    def parse_response(self, response):
        body = response.read()
        bodies.append(body.decode())
        parser, unmarshaller = self.getparser()
        parser.feed(body)
        parser.close()
        return unmarshaller.close()


proxy = xmlrpc.client.ServerProxy(
    f'http://127.0.0.1:{port}/ros2cli/', transport=Transport(), allow_none=True)


def call(name, *arguments):
    function = proxy
    for part in name.split('.'):
        function = getattr(function, part)
    result = function(*arguments)
    again = xmlrpc.client.dumps(
        (result,), methodresponse=True, allow_none=True)
    # Bytes are decoded as Binary, whose class encodes the same text.
    assert again == bodies[-1], f'{name}:\n{again}\n{bodies[-1]}'
    return shown(result)


def fault(name, *arguments):
    try:
        call(name, *arguments)
    except xmlrpc.client.Fault as error:
        assert xmlrpc.client.dumps(error, methodresponse=True) == bodies[-1], bodies[-1]
        return error.faultString
    raise AssertionError(name)


answers = {
    name: call(name)
    for name in ('system.listMethods', 'get_name', 'get_namespace', 'get_node_names_and_namespaces',
                 'get_node_names_and_namespaces_with_enclaves', 'get_topic_names_and_types',
                 'get_service_names_and_types', 'get_action_names_and_types',
                 'get_daemon_configuration')
}
ends = {}
for name, _ in answers['get_topic_names_and_types']:
    ends[name] = [call('get_publishers_info_by_topic', name),
                  call('get_subscriptions_info_by_topic', name)]
assert call('count_publishers', '/chatter') == len(ends['/chatter'][0])
assert call('count_subscribers', '/chatter') == len(ends['/chatter'][1])
services = {}
for name in ('/talker/get_parameters', '/nope'):
    services[name] = [call('count_services', name), call('count_clients', name)]
    if is_lyrical:
        assert len(call('get_servers_info_by_service', name)) == services[name][0]
        assert len(call('get_clients_info_by_service', name)) == services[name][1]
nodes = {}
for name, namespace in (('talker', '/'), ('lidar', '/robot1')):
    kinds = ('publisher', 'subscriber', 'service', 'client', 'action_server', 'action_client')
    nodes[f'{namespace}|{name}'] = {
        kind: call(f'get_{kind}_names_and_types_by_node', name, namespace) for kind in kinds}
faults = [fault('nope'), fault('get_publisher_names_and_types_by_node', 'nope', '/')]
print(json.dumps({**answers, 'ends': ends, 'services': services, 'nodes': nodes, 'faults': faults}))
