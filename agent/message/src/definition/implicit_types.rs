//! The types that services and actions imply, in addition to those in their files.

use crate::definition::{Element, Field, Kind, Shape, Structure, TypeName};

/// Returns the types that `rosidl_parser` composes.
pub(crate) fn implicit_types(name: &TypeName) -> Vec<Structure> {
    let mut structures = Vec::new();
    match name.kind() {
        Kind::Message => {}
        Kind::Service => service(name, &mut structures),
        Kind::Action => {
            let nested = |suffix: &str| Element::Nested(name.with_suffix(suffix));
            let goal_id = || single("goal_id", known("unique_identifier_msgs", "UUID"));
            let mut push = |suffix: &str, fields: Vec<Field>| {
                structures.push(Structure {
                    name: name.with_suffix(suffix),
                    fields,
                });
            };
            push(
                "_SendGoal_Request",
                vec![goal_id(), single("goal", nested("_Goal"))],
            );
            push(
                "_SendGoal_Response",
                vec![
                    single("accepted", Element::Bool),
                    single("stamp", known("builtin_interfaces", "Time")),
                ],
            );
            push("_GetResult_Request", vec![goal_id()]);
            push(
                "_GetResult_Response",
                vec![
                    single("status", Element::Int8),
                    single("result", nested("_Result")),
                ],
            );
            push(
                "_FeedbackMessage",
                vec![goal_id(), single("feedback", nested("_Feedback"))],
            );
            push(
                "",
                vec![
                    single("goal", nested("_Goal")),
                    single("result", nested("_Result")),
                    single("feedback", nested("_Feedback")),
                    single("send_goal_service", nested("_SendGoal")),
                    single("get_result_service", nested("_GetResult")),
                    single("feedback_message", nested("_FeedbackMessage")),
                ],
            );
            service(&name.with_suffix("_SendGoal"), &mut structures);
            service(&name.with_suffix("_GetResult"), &mut structures);
        }
    }
    structures
}

/// Adds a service's event and the service itself, of which only the hash is used.
fn service(name: &TypeName, structures: &mut Vec<Structure>) {
    let nested = |suffix: &str| Element::Nested(name.with_suffix(suffix));
    let one_at_most = |member: &str, suffix: &str| Field {
        name: member.to_owned(),
        element: nested(suffix),
        shape: Shape::Bounded(1),
    };
    structures.push(Structure {
        name: name.with_suffix("_Event"),
        fields: vec![
            single("info", known("service_msgs", "ServiceEventInfo")),
            one_at_most("request", "_Request"),
            one_at_most("response", "_Response"),
        ],
    });
    structures.push(Structure {
        name: name.clone(),
        fields: vec![
            single("request_message", nested("_Request")),
            single("response_message", nested("_Response")),
            single("event_message", nested("_Event")),
        ],
    });
}

fn single(name: &str, element: Element) -> Field {
    Field {
        name: name.to_owned(),
        element,
        shape: Shape::Single,
    }
}

fn known(package: &'static str, name: &'static str) -> Element {
    Element::Nested(TypeName::message(package, name))
}
