//! Services by which a client begins and ends episodes, and arms and disarms.
//!
//! Invariant: there are none unless the user allowed them: the protocol has no password, and web pages of a browser on
//! this machine reach a loopback address too.

use std::sync::Arc;

use foxglove::Schema;
use foxglove::websocket::service::{Service, ServiceSchema};
use tokio::sync::oneshot;

use crate::permission::Permission;
use crate::status::session::SessionRequest;
use crate::time::Stamp;

/// Passes a request to the session on; the answer is what was done, or why it was refused.
pub type Asker = Arc<dyn Fn(SessionRequest, oneshot::Sender<Result<String, String>>) + Send + Sync>;

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

/// JSON Schema of a request, which has no fields, and of an answer.
const REQUEST: &str = r#"{"type":"object","properties":{}}"#;
const ANSWER: &str = r#"{"type":"object","properties":{"text":{"type":"string"}}}"#;

impl Controls {
    /// The services.
    pub(super) fn services(&self) -> Vec<Service> {
        let service = |(control, name): (Control, &'static str)| {
            let schema = |name, text: &'static str| Schema::new(name, "jsonschema", text.as_bytes());
            let described = ServiceSchema::new("rapid.Control")
                .with_request("json", schema("rapid.ControlRequest", REQUEST))
                .with_response("json", schema("rapid.ControlAnswer", ANSWER));
            let controls = self.clone();
            Service::builder(name, described).async_handler_fn(move |_| {
                let controls = controls.clone();
                async move {
                    let answer = controls.carry_out(control).await;
                    let (Ok(text) | Err(text)) = &answer;
                    tracing::info!("Foxglove: a client called {name}: {text}");
                    answer.map(|text| serde_json::json!({ "text": text }).to_string())
                }
            })
        };
        Control::ALL.into_iter().map(service).collect()
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
}
