//! Answers of the functions for a robot with every kind of endpoint, by distribution.

mod robot;

use std::sync::Arc;

use ros2probe_message::Dialect;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts};
use ros2probe_wire::DomainId;
use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::qos::{History, HistoryKind, Qos, Role};
use ros2probe_wire::rtps::VendorId;

use super::call::{Argument, Call};
use super::function::{self, ALL, Caller, Query};
use super::graph::Graph;
use super::value::{Fault, Value, answer};
use robot::robot;

/// Answer of a real daemon of ROS 2 Humble (ros2cli 0.18.11) to `get_publishers_info_by_topic`.
const HUMBLE: &str = include_str!("tests/humble_publishers.xml");
/// A client of one distribution.
struct Fixed(Dialect);

impl Caller for Fixed {
    fn dialect(&self) -> Dialect {
        self.0
    }

    fn rmw_implementation(&self) -> String {
        "rmw_cyclonedds_cpp".to_owned()
    }
}

/// Calls a function with text arguments.
fn ask(
    snapshot: &Snapshot,
    dialect: Dialect,
    method: &str,
    arguments: &[&str],
) -> Result<Value, Fault> {
    let arguments = arguments
        .iter()
        .map(|text| Argument::Text((*text).to_owned()));
    let call = Call {
        method: method.to_owned(),
        arguments: arguments.collect(),
    };
    let caller = Fixed(dialect);
    let domain_id = DomainId(0);
    let query = Query {
        graph: Graph::new(snapshot, domain_id),
        domain_id,
        name: "_ros2cli_daemon_0_00",
        caller: &caller,
    };
    function::answer(&call, &query)
}

fn asked(method: &str, arguments: &[&str]) -> Value {
    ask(&robot(), Dialect::Jazzy, method, arguments).unwrap()
}

/// Names with types, in the form of an answer.
fn named(names: &[(&str, &str)]) -> Value {
    Value::array(
        names.iter().map(|(name, kind)| {
            Value::array([Value::text(name), Value::array([Value::text(kind)])])
        }),
    )
}

#[test]
fn a_humble_client_receives_the_bytes_of_a_real_daemon() {
    let method = "get_publishers_info_by_topic";
    for name in ["/chatter", "chatter"] {
        let result = ask(&robot(), Dialect::Humble, method, &[name]);
        assert_eq!(answer(&result), HUMBLE);
    }
}

#[test]
fn later_distributions_receive_a_hash_a_short_gid_and_their_own_classes() {
    let mut robot = robot();
    robot.topics[0].publishers[0].type_hash = Some(TypeHash(std::array::from_fn(|at| at as u8)));
    robot.topics[0].publishers[0].qos = Arc::new(Qos {
        history: Some(History {
            kind: HistoryKind::KEEP_LAST,
            depth: 7,
        }),
        ..Qos::defaults(Role::Writer, VendorId::EPROSIMA)
    });
    let hash = "<member>\n<name>topic_type_hash</name>\n<value><rclpy.type_hash.TypeHash><value>\
        <struct>\n<member>\n<name>version</name>\n<value><int>1</int></value>\n</member>\n\
        <member>\n<name>value</name>\n<value><base64>\n\
        AAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8=\n</base64></value>\n</member>\n\
        </struct></value>\n</rclpy.type_hash.TypeHash></value></member>\n";
    let padding = "<value><int>0</int></value>\n".repeat(8);
    let history = "<name>history</name>\n<value><rclpy.qos.HistoryPolicy>3</rclpy.qos.HistoryPolicy>\
        </value></member>\n<member>\n<name>depth</name>\n<value><int>0</int>";
    let expected = HUMBLE
        .replace(
            "<member>\n<name>endpoint_type</name>",
            &format!("{hash}<member>\n<name>endpoint_type</name>"),
        )
        .replace(
            &format!("<value><int>3</int></value>\n{padding}"),
            "<value><int>3</int></value>\n",
        )
        .replace(
            history,
            &history.replace(">3<", ">1<").replace("<int>0<", "<int>7<"),
        );
    let lyrical = expected
        .replace(
            "rclpy.topic_endpoint_info.TopicEndpointInfo",
            "rclpy.endpoint_info.TopicEndpointInfo",
        )
        .replace(
            "rclpy.topic_endpoint_info.TopicEndpointTypeEnum",
            "rclpy.endpoint_info.EndpointTypeEnum",
        );
    for (dialect, expected) in [
        (Dialect::Jazzy, &expected),
        (Dialect::Kilted, &expected),
        (Dialect::Rolling, &lyrical),
    ] {
        let result = ask(
            &robot,
            dialect,
            "get_publishers_info_by_topic",
            &["/chatter"],
        );
        assert_eq!(&answer(&result), expected, "{dialect:?}");
    }
}

#[test]
fn an_endpoint_without_a_node_has_the_placeholder_of_its_participant() {
    let mut robot = robot();
    let info = |robot: &Snapshot| {
        let result = ask(
            robot,
            Dialect::Jazzy,
            "get_publishers_info_by_topic",
            &["/bare"],
        );
        answer(&result)
    };
    assert!(info(&robot).contains("<string>_NODE_NAME_UNKNOWN_</string>"));
    assert!(info(&robot).contains("<name>version</name>\n<value><int>0</int></value>"));
    robot.participants[0].enclave = None;
    assert_eq!(info(&robot).matches("_CREATED_BY_BARE_DDS_APP_").count(), 2);
}

#[test]
fn lyrical_receives_both_endpoints_of_services_and_all_parts_of_actions() {
    let info = |method: &str, name: &str| answer(&ask(&robot(), Dialect::Rolling, method, &[name]));
    let entities = |body: &str| -> Vec<[String; 2]> {
        let numbers: Vec<&str> = body
            .split("<int>")
            .skip(1)
            .map(|rest| rest.split('<').next().unwrap())
            .collect();
        let ends = numbers
            .windows(4)
            .filter(|four| four[0] == "0" && four[1] == "0");
        let ends = ends.filter(|four| ["3", "4"].contains(&four[3]) && four[2] != "0");
        ends.map(|four| [four[2].to_owned(), four[3].to_owned()])
            .collect()
    };
    let servers = info("get_servers_info_by_service", "/add");
    assert_eq!(entities(&servers), [["40", "4"], ["41", "3"]]);
    assert!(servers.contains("<rclpy.endpoint_info.ServiceEndpointInfo>"));
    assert!(servers.contains("<string>a/srv/Add</string>"));
    assert!(servers.contains("<rclpy.endpoint_info.EndpointTypeEnum>4<"));
    assert!(servers.contains("<name>endpoint_count</name>\n<value><int>2</int></value>"));
    let clients = info("get_clients_info_by_service", "/add");
    assert_eq!(entities(&clients), [["40", "3"], ["41", "4"]]);
    assert!(clients.contains("<rclpy.endpoint_info.EndpointTypeEnum>3<"));
    let servers = info("get_action_servers_info_by_action", "/fib");
    assert_eq!(
        servers
            .matches("<rclpy.endpoint_info.ServiceEndpointInfo>")
            .count(),
        3
    );
    assert_eq!(
        servers
            .matches("<rclpy.endpoint_info.TopicEndpointInfo>")
            .count(),
        2
    );
    assert_eq!(
        servers
            .matches("<rclpy.endpoint_info.ActionEndpointInfo>")
            .count(),
        1
    );
    for part in [
        "goal_service",
        "cancel_service",
        "result_service",
        "feedback_topic",
        "status_topic",
    ] {
        assert!(
            servers.contains(&format!("<name>{part}_info</name>")),
            "{part}"
        );
    }
    let clients = info("get_action_clients_info_by_action", "/fib");
    assert!(clients.contains("<string>client</string>"));
    for (method, name) in [
        ("get_servers_info_by_service", "/nope"),
        ("get_action_servers_info_by_action", "/nope"),
    ] {
        assert_eq!(info(method, name).matches("<value>").count(), 1, "{method}");
    }
}

#[test]
fn a_server_or_client_of_zenoh_has_one_endpoint() {
    let mut robot = robot();
    for topic in &mut robot.topics {
        for endpoint in topic.publishers.iter_mut().chain(&mut topic.subscriptions) {
            endpoint.guid.prefix.0[..2].copy_from_slice(&VendorId::ZENOH.0);
        }
    }
    for method in ["get_servers_info_by_service", "get_clients_info_by_service"] {
        let info = answer(&ask(&robot, Dialect::Rolling, method, &["/add"]));
        assert!(
            info.contains("<name>endpoint_count</name>\n<value><int>1</int></value>"),
            "{method}"
        );
        assert_eq!(
            info.matches("<rclpy.qos.QoSProfile>").count(),
            1,
            "{method}"
        );
    }
}

#[test]
fn names_counts_and_nodes_are_returned_as_by_rclpy() {
    let text = |text: &str| Value::text(text);
    let string = "std_msgs/msg/String";
    assert_eq!(
        asked("get_topic_names_and_types", &[]),
        named(&[
            ("/bare", string),
            ("/chatter", string),
            ("/fib/_action/feedback", "a/action/Fib_FeedbackMessage"),
            ("/fib/_action/status", "action_msgs/msg/GoalStatusArray"),
        ])
    );
    let services = [
        ("/add", "a/srv/Add"),
        ("/fib/_action/cancel_goal", "action_msgs/srv/CancelGoal"),
        ("/fib/_action/get_result", "a/action/Fib_GetResult"),
        ("/fib/_action/send_goal", "a/action/Fib_SendGoal"),
    ];
    assert_eq!(asked("get_service_names_and_types", &[]), named(&services));
    let action = named(&[("/fib", "a/action/Fib")]);
    assert_eq!(asked("get_action_names_and_types", &[]), action);
    let node = |method: &str, name, namespace| asked(method, &[name, namespace]);
    let (server, client) = (("server", "/robot1"), ("client", "/"));
    for (method, (name, namespace), expected) in [
        (
            "get_publisher_names_and_types_by_node",
            ("talker", "/"),
            named(&[("/chatter", string)]),
        ),
        (
            "get_subscriber_names_and_types_by_node",
            ("talker", "/"),
            named(&[]),
        ),
        (
            "get_service_names_and_types_by_node",
            server,
            named(&services),
        ),
        ("get_service_names_and_types_by_node", client, named(&[])),
        (
            "get_client_names_and_types_by_node",
            client,
            named(&services),
        ),
        (
            "get_action_server_names_and_types_by_node",
            server,
            action.clone(),
        ),
        (
            "get_action_server_names_and_types_by_node",
            client,
            named(&[]),
        ),
        (
            "get_action_client_names_and_types_by_node",
            client,
            action.clone(),
        ),
    ] {
        assert_eq!(node(method, name, namespace), expected, "{method} {name}");
    }
    for (method, name, count) in [
        ("count_publishers", "/chatter", 1),
        ("count_publishers", "/nope", 0),
        ("count_subscribers", "/fib/_action/feedback", 1),
        ("count_clients", "/add", 1),
        ("count_services", "/add", 1),
        ("count_action_clients", "/fib", 1),
        ("count_action_servers", "/fib", 1),
        ("count_action_servers", "/nope", 0),
    ] {
        assert_eq!(
            asked(method, &[name]),
            Value::Integer(count),
            "{method} {name}"
        );
    }
    let nodes = [
        ("client", "/"),
        ("server", "/robot1"),
        ("talker", "/"),
        ("talker", "/"),
    ];
    let pairs = nodes.map(|(name, namespace)| Value::array([text(name), text(namespace)]));
    assert_eq!(
        asked("get_node_names_and_namespaces", &[]),
        Value::array(pairs)
    );
    let triples = nodes.map(|(name, namespace)| Value::array([name, namespace, "/"].map(text)));
    let method = "get_node_names_and_namespaces_with_enclaves";
    assert_eq!(asked(method, &[]), Value::array(triples));
    assert_eq!(asked("get_name", &[]), text("_ros2cli_daemon_0_00"));
    assert_eq!(asked("get_namespace", &[]), text("/"));
    let configuration = vec![
        ("ros_domain_id", Value::Integer(0)),
        ("rmw_implementation", text("rmw_cyclonedds_cpp")),
    ];
    assert_eq!(
        asked("get_daemon_configuration", &[]),
        Value::Struct(configuration)
    );
}

#[test]
fn servers_are_counted_by_replies_until_kilted_and_then_by_requests() {
    let mut robot = robot();
    let replies =
        |topic: &&mut TopicFacts| *topic.name == *"/add" && topic.kind == TopicKind::ServiceReply;
    robot
        .topics
        .iter_mut()
        .find(replies)
        .unwrap()
        .publishers
        .clear();
    for (dialect, count) in [
        (Dialect::Jazzy, 0),
        (Dialect::Kilted, 0),
        (Dialect::Rolling, 1),
    ] {
        let counted = ask(&robot, dialect, "count_services", &["/add"]).unwrap();
        assert_eq!(counted, Value::Integer(count), "{dialect:?}");
    }
}

#[test]
fn an_invalid_call_leads_to_the_fault_of_a_real_daemon() {
    let nonexistent = "rclpy._rclpy_pybind11.NodeNameNonExistentError";
    let rcl = "rclpy._rclpy_pybind11.RCLError";
    let cases: [(&str, &[&str], &str, &str); 11] = [
        ("nope", &[], "Exception", "method \"nope\" is not supported"),
        (
            "get_publisher_names_and_types_by_node",
            &["nope", "/"],
            nonexistent,
            "cannot get publisher names and types for nonexistent node: error not set",
        ),
        (
            "get_subscriber_names_and_types_by_node",
            &["talker", "/x"],
            nonexistent,
            "cannot get subscriber names and types for nonexistent node: error not set",
        ),
        (
            "get_service_names_and_types_by_node",
            &["nope", "/"],
            nonexistent,
            "cannot get service names and types for nonexistent node: error not set",
        ),
        (
            "get_client_names_and_types_by_node",
            &["nope", "/"],
            nonexistent,
            "cannot get client names and types for nonexistent node: error not set",
        ),
        (
            "get_action_server_names_and_types_by_node",
            &["nope", "/"],
            rcl,
            "Failed to get action server names and type: error not set",
        ),
        (
            "get_action_client_names_and_types_by_node",
            &["nope", "/"],
            rcl,
            "Failed to get action client names and type: error not set",
        ),
        (
            "get_publisher_names_and_types_by_node",
            &["talker"],
            "TypeError",
            "Node.get_publisher_names_and_types_by_node() missing 1 required positional argument: \
             'node_namespace'",
        ),
        (
            "count_publishers",
            &["/a", "/b", "/c"],
            "TypeError",
            "Node.count_publishers() takes 2 positional arguments but 4 were given",
        ),
        (
            "get_name",
            &["extra"],
            "TypeError",
            "Node.get_name() takes 1 positional argument but 2 were given",
        ),
        (
            "count_publishers",
            &["ch-atter"],
            "ValueError",
            "topic name 'ch-atter' is invalid: topic name is invalid",
        ),
    ];
    for (method, arguments, class, text) in cases {
        let fault = ask(&robot(), Dialect::Humble, method, arguments).unwrap_err();
        assert_eq!(fault, Fault::new(class, text), "{method}");
    }
}

#[test]
fn the_functions_of_each_distribution_are_listed_in_order() {
    let Value::Array(listed) = asked("system.listMethods", &[]) else {
        panic!("no array");
    };
    let listed: Vec<_> = listed
        .into_iter()
        .map(|value| match value {
            Value::Text(name) => name,
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(listed.is_sorted() && listed.len() == ALL.len());
    let humble = include_str!("tests/humble_functions.txt");
    let jazzy = ["count_clients", "count_services"];
    let lyrical = [
        "get_servers_info_by_service",
        "get_clients_info_by_service",
        "get_action_servers_info_by_action",
        "get_action_clients_info_by_action",
        "count_action_servers",
        "count_action_clients",
        "get_daemon_configuration",
    ];
    let expected: std::collections::BTreeSet<_> = humble
        .lines()
        .chain(jazzy)
        .chain(lyrical)
        .map(str::to_owned)
        .collect();
    assert_eq!(listed, expected.into_iter().collect::<Vec<_>>());
    assert_eq!(
        asked("system.methodHelp", &["get_name"]),
        Value::text("Get the name of the node.")
    );
    assert_eq!(asked("system.methodHelp", &["nope"]), Value::text(""));
    let signature = Value::text("signatures not supported");
    assert_eq!(asked("system.methodSignature", &["get_name"]), signature);
}

#[test]
fn an_extra_boolean_is_accepted_only_if_it_is_false() {
    let robot = robot();
    let caller = Fixed(Dialect::Jazzy);
    let query = Query {
        graph: Graph::new(&robot, DomainId(0)),
        domain_id: DomainId(0),
        name: "",
        caller: &caller,
    };
    let flagged = |flag| {
        let call = Call {
            method: "get_topic_names_and_types".to_owned(),
            arguments: vec![Argument::Boolean(flag)],
        };
        function::answer(&call, &query)
    };
    assert_eq!(
        flagged(false).unwrap(),
        asked("get_topic_names_and_types", &[])
    );
    assert!(flagged(true).is_err());
}

#[test]
fn an_answer_with_endpoints_beyond_the_cap_is_a_fault() {
    let mut robot = robot();
    let one = robot.topics[0].publishers[0].clone();
    let method = "get_publishers_info_by_topic";
    robot.topics[0].publishers = vec![one; function::MAX_ENDPOINTS];
    let most = ask(&robot, Dialect::Jazzy, method, &["/chatter"]);
    let body = answer(&most);
    assert!(body.contains("<params>"), "{}", body.len());
    let one = robot.topics[0].publishers[0].clone();
    robot.topics[0].publishers.push(one);
    let fault = ask(&robot, Dialect::Jazzy, method, &["/chatter"]).unwrap_err();
    let text = "1025 endpoints; an answer has room for 1024";
    assert_eq!(fault, Fault::new("MemoryError", text));
}

#[test]
fn other_domains_are_not_in_the_answer() {
    let mut robot = robot();
    for topic in &mut robot.topics {
        topic.domain_id = DomainId(7);
    }
    for node in &mut robot.nodes {
        node.domain_id = DomainId(7);
    }
    let methods = [
        "get_topic_names_and_types",
        "get_service_names_and_types",
        "get_node_names_and_namespaces",
    ];
    for method in methods {
        let nothing = ask(&robot, Dialect::Jazzy, method, &[]).unwrap();
        assert_eq!(nothing, Value::array([]), "{method}");
    }
}
