//! Services by which a client begins and ends episodes, and arms and disarms, and parameters: task and tags.
//!
//! Invariant: there are none unless the user allowed them: the protocol has no password, and every program of
//! this machine reaches a loopback address too.

use std::collections::BTreeMap;
use std::sync::Arc;

use foxglove::ws_protocol::client::{ClientMessage, ServiceCallRequest};
use foxglove::ws_protocol::parameter::{Parameter, ParameterValue};
use foxglove::ws_protocol::schema::{EncodeError, Schema};
use foxglove::ws_protocol::server::advertise_services::Service;
use foxglove::ws_protocol::server::{AdvertiseServices, ParameterValues, ServiceCallFailure, ServiceCallResponse};
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_status::session::{Asker, SessionRequest};
use tokio::sync::oneshot;
use tokio_tungstenite::tungstenite::Message;

/// What clients may request.
#[derive(Clone)]
pub struct Controls {
    /// The session.
    pub ask: Asker,
    /// The actuator.
    pub permission: Arc<Permission>,
}

impl std::fmt::Debug for Controls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Controls").finish_non_exhaustive()
    }
}

/// A service.
#[derive(Debug, Clone, Copy)]
enum Control {
    Start,
    Stop,
    Arm,
    Disarm,
}

impl Control {
    const ALL: [(Self, &'static str); 4] = [
        (Self::Start, "/rapid/start"),
        (Self::Stop, "/rapid/stop"),
        (Self::Arm, "/rapid/arm"),
        (Self::Disarm, "/rapid/disarm"),
    ];
}

/// The encoding of requests and answers.
pub(super) const JSON: &str = "json";
/// JSON Schema of a request, which has no fields, and of an answer.
const REQUEST: &str = r#"{"type":"object","properties":{}}"#;
const ANSWER: &str = r#"{"type":"object","properties":{"text":{"type":"string"}}}"#;

impl Controls {
    /// The message that offers the services.
    ///
    /// # Errors
    /// None: their schemas are texts.
    pub(super) fn services() -> Result<Message, EncodeError> {
        let schema = |name: &'static str, text: &'static str| Schema::new(name, "jsonschema", text.as_bytes());
        let service = |(id, (_, name)): (u32, (Control, &'static str))| {
            Service::new(id, name, "rapid.Control")
                .with_request(JSON, schema("rapid.ControlRequest", REQUEST))?
                .with_response(JSON, schema("rapid.ControlAnswer", ANSWER))
        };
        let services = (0..).zip(Control::ALL).map(service).collect::<Result<Vec<_>, _>>()?;
        Ok(Message::from(&AdvertiseServices::new(services)))
    }

    /// Carries out a request, and returns its answer.
    pub(super) async fn answer(&self, request: ClientMessage<'static>) -> Option<Message> {
        match request {
            ClientMessage::ServiceCallRequest(call) => Some(self.call(call).await),
            ClientMessage::GetParameters(get) => Some(self.values(&get.parameter_names, get.id).await),
            ClientMessage::SetParameters(set) => {
                let names: Vec<_> = set.parameters.iter().map(|parameter| parameter.name.clone()).collect();
                self.change(set.parameters).await;
                // As they are now, whether they were changed or not.
                Some(self.values(&names, set.id).await)
            }
            _ => None,
        }
    }

    async fn call(&self, call: ServiceCallRequest<'static>) -> Message {
        let ServiceCallRequest { service_id, call_id, .. } = call;
        let service = usize::try_from(service_id).ok().and_then(|id| Control::ALL.get(id));
        let Some((control, name)) = service else {
            return Message::from(&ServiceCallFailure::new(service_id, call_id, "there is no such service"));
        };
        let answer = self.carry_out(*control).await;
        let (Ok(text) | Err(text)) = &answer;
        tracing::info!("Foxglove: a client called {name}: {text}");
        match answer {
            Ok(text) => {
                let payload = serde_json::json!({ "text": text }).to_string().into_bytes().into();
                Message::from(&ServiceCallResponse { service_id, call_id, encoding: JSON.into(), payload })
            }
            Err(text) => Message::from(&ServiceCallFailure::new(service_id, call_id, text)),
        }
    }

    async fn values(&self, names: &[String], id: Option<String>) -> Message {
        let mut values = ParameterValues::new(self.parameters(names).await);
        values.id = id;
        Message::from(&values)
    }

    async fn carry_out(&self, control: Control) -> Result<String, String> {
        let now = Stamp::now();
        match control {
            Control::Start => self.request(SessionRequest::Start).await,
            Control::Stop => self.request(SessionRequest::Stop).await,
            Control::Arm => {
                let armed = self.permission.arm(now, Stamp::now());
                armed.map(|()| "armed".to_owned()).map_err(|void| void.to_string())
            }
            Control::Disarm => {
                let is_plugged_in = self.permission.disarm(now);
                Ok(if is_plugged_in { "disarmed" } else { "disarmed; no actuator is plugged in" }.to_owned())
            }
        }
    }

    async fn request(&self, request: SessionRequest) -> Result<String, String> {
        let (reply, answer) = oneshot::channel();
        (self.ask)(request, reply);
        answer.await.unwrap_or_else(|_| Err("the run is ending".to_owned()))
    }

    /// The parameters of these names, or all if none is named; none while the run ends.
    async fn parameters(&self, names: &[String]) -> Vec<Parameter> {
        let shown = self.request(SessionRequest::Show).await.unwrap_or_default();
        let session = serde_json::from_str::<Session>(&shown).unwrap_or_default();
        let tags = session.tags.into_iter().map(|(key, value)| (key, ParameterValue::String(value))).collect();
        let all = [(TASK, ParameterValue::String(session.task)), (TAGS, ParameterValue::Dict(tags))];
        let wanted = all.into_iter().filter(|(name, _)| names.is_empty() || names.iter().any(|other| other == name));
        wanted.map(|(name, value)| Parameter { name: name.to_owned(), r#type: None, value: Some(value) }).collect()
    }

    /// Changes what the next episodes are of. What is neither a task nor a tag changes nothing.
    async fn change(&self, parameters: Vec<Parameter>) {
        let Some(plan) = plan(parameters) else { return };
        let (Ok(text) | Err(text)) = self.request(plan).await;
        tracing::info!("Foxglove: a client set parameters: {text}");
    }
}

/// Names of parameters.
const TASK: &str = "task";
const TAGS: &str = "tags";

/// What is read of the session.
#[derive(serde::Deserialize, Default)]
struct Session {
    task: String,
    tags: Vec<(String, String)>,
}

/// What these parameters request; `None` if nothing. A tag with an empty text is removed.
fn plan(parameters: Vec<Parameter>) -> Option<SessionRequest> {
    let (mut task, mut tags) = (None, Vec::new());
    for Parameter { name, value, .. } in parameters {
        match (name.as_str(), value) {
            (TASK, Some(ParameterValue::String(text))) => task = Some(text),
            (TAGS, Some(ParameterValue::Dict(dict))) => tags.extend(texts(dict)),
            _ => {}
        }
    }
    (task.is_some() || !tags.is_empty()).then_some(SessionRequest::Plan { task, tags, goal: None, modules: Vec::new() })
}

fn texts(dict: BTreeMap<String, ParameterValue>) -> impl Iterator<Item = (String, String)> {
    let text = |(key, value)| if let ParameterValue::String(text) = value { Some((key, text)) } else { None };
    dict.into_iter().filter_map(text)
}
