//! Network messages. A publication, request or reply becomes a sample of the writer that its
//! attachment identifies.

use ros2probe_wire::Guid;
use ros2probe_wire::zenoh::{
    Attachment, Bytes, Declaration, Gid, Interest, Key, Mapping, NetworkMessage, Put, Request,
    Response, ResponseBody, Sample, WireExpr, ZenohId,
};

use super::Place;
use super::ReportFact;
use super::Zenoh;
use super::ZenohSample;
use super::endpoints::unknown_guid;
use super::graph::service_key;
use super::routers::domain_of_graph;
use super::stream::StreamId;
use super::stream_state::{Alias, Channel, resolve};

impl Zenoh {
    pub(super) fn network(
        &mut self,
        place: Place<'_>,
        message: &NetworkMessage<'_>,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        match message {
            NetworkMessage::Push(push) => {
                if let Sample::Put(put) = push.sample {
                    self.sample(place, push.key, &put, show);
                }
            }
            NetworkMessage::Declare(declare) => {
                self.declaration(place.stream, declare.declaration);
                if let (Declaration::Final, Some(interest)) =
                    (declare.declaration, declare.interest)
                {
                    self.remove_omitted_tokens(place.stream, interest);
                }
            }
            NetworkMessage::Interest(interest) => self.interest(place.stream, interest),
            NetworkMessage::Request(request) => self.request(place, request, show),
            NetworkMessage::Response(response) => self.response(place, response, show),
            NetworkMessage::ResponseFinal(_) | NetworkMessage::Oam(_) => {}
        }
    }

    /// Returns the key of an expression; `None` if its alias is older than the capture.
    pub(super) fn resolve(&self, stream: &StreamId, expression: WireExpr<'_>) -> Option<Alias> {
        let table = match expression.mapping {
            Mapping::Sender => self.directions.get(stream).map(|known| &**known),
            Mapping::Receiver => self.opposite(stream),
        };
        let number = table.map(|direction| direction.number);
        resolve(expression, &self.aliases, number)
    }

    /// Records that a session requests the graph of a domain.
    fn interest(&mut self, stream: &StreamId, interest: &Interest<'_>) {
        let key = interest.key.filter(|_| interest.is_current);
        let key = key.and_then(|key| self.resolve(stream, key));
        let domain = key.and_then(|alias| domain_of_graph(&alias.key));
        if let (Some(domain), Some(direction)) = (domain, self.directions.get_mut(stream)) {
            direction.requested_interest = Some((interest.id, domain));
        }
    }

    /// Passes a sample of a topic to `show`.
    fn sample(
        &mut self,
        place: Place<'_>,
        key: WireExpr<'_>,
        put: &Put<'_>,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        let alias = self.resolve(place.stream, key);
        let channel = alias.map_or(Channel::Messages, |alias| alias.channel);
        if channel == Channel::Other {
            return;
        }
        let Some(attachment) = attachment(put) else {
            self.counters.foreign += 1;
            return;
        };
        let writer = self.graph.writer(attachment.gid);
        let writer = writer.unwrap_or_else(|| unknown_guid(attachment.gid));
        self.note_source(place.stream, attachment.gid, show);
        let sample = self.arrived(place, writer, &attachment, put.payload);
        show(ReportFact::Sample(&ZenohSample {
            referring: match channel {
                Channel::References(subscription) => Some(subscription),
                Channel::Messages | Channel::Other => None,
            },
            ..sample
        }));
    }

    /// Passes the request of a service's client to `show`.
    fn request(
        &self,
        place: Place<'_>,
        request: &Request<'_>,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        let Some(attachment) = request.query.attachment.and_then(read_attachment) else {
            return;
        };
        let Some((_, payload)) = request.query.body else {
            return;
        };
        let Some(writer) = self.graph.writer(attachment.gid) else {
            return;
        };
        show(ReportFact::Sample(&ZenohSample {
            call: Some((attachment.gid, attachment.sequence_number)),
            ..self.arrived(place, writer, &attachment, payload)
        }));
    }

    /// Passes the reply of a service, or a sample of a topic's history, to `show`.
    fn response(
        &mut self,
        place: Place<'_>,
        response: &Response<'_>,
        show: &mut impl FnMut(ReportFact<'_>),
    ) {
        let ResponseBody::Reply {
            sample: Sample::Put(put),
            ..
        } = response.body
        else {
            return;
        };
        let Some(alias) = self.resolve(place.stream, response.key) else {
            return;
        };
        let Ok(Key::Topic(key)) = Key::parse(&alias.key) else {
            return;
        };
        if !key.is_service() {
            self.sample(place, response.key, &put, show);
            return;
        }
        let Some(attachment) = attachment(&put) else {
            return;
        };
        let direction = self.directions.get(place.stream);
        let responder = response.responder.map(|responder| responder.session);
        let responder = responder.filter(|session| self.graph.has(*session));
        let session = responder.or(direction.and_then(|direction| direction.session()));
        let service = service_key(key.domain, key.name.as_str());
        let Some(writer) = self.graph.server(&service, session) else {
            return;
        };
        let call = (attachment.gid, attachment.sequence_number);
        let number = self.replies.number(writer, call);
        show(ReportFact::Sample(&ZenohSample {
            number,
            call: Some(call),
            ..self.arrived(place, writer, &attachment, put.payload)
        }));
    }

    /// Returns the sample of a message, with the receiver according to the connection.
    fn arrived<'a>(
        &self,
        place: Place<'_>,
        writer: Guid,
        attachment: &Attachment,
        payload: Bytes<'a>,
    ) -> ZenohSample<'a> {
        let session = self.receiver(place.stream).map(|side| side.zid);
        let session = session.or_else(|| self.opposite(place.stream)?.session());
        let is_router = self.is_for_router(place.stream);
        ZenohSample {
            writer,
            number: attachment.sequence_number,
            source_timestamp: attachment.source_timestamp,
            payload,
            receiver: session.map(ZenohId::guid_prefix).filter(|_| !is_router),
            is_relayed: is_router,
            receiving_socket: self.receiving_socket(place.stream),
            began: place.began,
            call: None,
            referring: None,
        }
    }

    /// Derives from a publication the sender on a connection whose start was missed.
    fn note_source(&mut self, stream: &StreamId, gid: Gid, show: &mut impl FnMut(ReportFact<'_>)) {
        let Some(session) = self.graph.session(gid) else {
            return;
        };
        if let Some(direction) = self.directions.get_mut(stream)
            && direction.sender.is_none()
        {
            let before = direction.owner(stream);
            direction.note_source(session);
            match (before, direction.owner(stream)) {
                (None, Some(owner)) => show(ReportFact::Owner(stream.socket, owner.guid_prefix())),
                (Some(owner), None) => {
                    show(ReportFact::Disowned(stream.socket, owner.guid_prefix()));
                }
                _ => {}
            }
        }
    }
}

/// Returns the attachment of rmw_zenoh, if the message has one.
pub(super) fn attachment(put: &Put<'_>) -> Option<Attachment> {
    put.attachment.and_then(read_attachment)
}

fn read_attachment(bytes: Bytes<'_>) -> Option<Attachment> {
    Attachment::parse(bytes.whole()?).ok()
}
