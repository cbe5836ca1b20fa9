//! Connections and requests.
//!
//! | request | answer |
//! |---|---|
//! | `GET /`, `/page.css`, `/page.js` | the page |
//! | `POST /enter`, the token as its body | a cookie, or 401; 204 for those who need none |
//! | `GET /events` | server-sent events: `view`, a [`View`], when it has changed, and `beat` each second |
//! | `GET /picture/BIT?after=SEQ` | the newest picture of a camera, or 204 while there is none after that one |
//! | `POST /do`, a [`SessionRequest`] as JSON | what was done, or why it was refused |
//!
//! Invariant: a connection that requests nothing and takes nothing for [`STUCK`] is closed; there are [`CONNECTIONS`] at
//! most, and each holds a few messages.
//! Invariant: those who have not got anything of the rig keep nobody out: when all places are in use, one of them gives way.
//! Invariant: nothing is sent to who is not let in any more: each message of a stream needs the token in force.

use std::cell::{Cell, RefCell};
use std::convert::Infallible;
use std::io::Write as _;
use std::net::SocketAddr;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use http_body_util::{BodyExt as _, Collected, Limited};
use hyper::body::{Body, Bytes, Frame, Incoming, SizeHint};
use hyper::header::{CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue, SET_COOKIE};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use rapid_core::modality::ModalityId;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::Board;
use rapid_status::rates::Rates;
use rapid_status::session::{Asker, SessionRequest};
use rapid_system::fault;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Notify, mpsc, oneshot, watch};
use tokio::task::spawn_local;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, sleep_until};

use super::door::{Asked, Door, NO_TOKEN, Refusal};
use super::pictures::Pictures;
use super::token::Source;
use super::view::View;

/// Connections at a time: a page has two to six.
const CONNECTIONS: usize = 32;
/// See the module's comment.
const STUCK: Duration = Duration::from_secs(15);
/// Time between two looks at the board, while a page is open.
const TURN: Duration = Duration::from_millis(250);
/// Time between two signs of life; the page counts on it.
const BEAT: Duration = Duration::from_secs(1);
/// After the system refused a connection.
const PAUSE: Duration = Duration::from_millis(200);
/// Longest line of a request with its headers, bytes.
const LONGEST_HEAD: usize = 16_384;
/// Longest body of a request, bytes: a note of 500 characters, each of them escaped, is less.
const LONGEST_BODY: usize = 8192;

/// The answer to a connection beyond [`CONNECTIONS`].
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-length: 0\r\n\r\n";

/// What the page is made of, and its types.
const PAGE: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/page.html")),
    ("/page.css", "text/css; charset=utf-8", include_str!("page/page.css")),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("page/page.js")),
];
/// The page loads nothing from elsewhere, is shown in no other page, and nothing is kept.
const HEADERS: [(&str, &str); 5] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob: data:; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cache-control", "no-store"),
];

/// The server's side of all pages.
pub(super) struct Server {
    pub(super) door: Door,
    pub(super) board: Arc<Board>,
    pub(super) ask: Asker,
    /// The newest [`View`], as JSON.
    views: watch::Sender<Arc<str>>,
    rates: RefCell<Rates>,
    pictures: RefCell<Pictures>,
    /// The oldest first.
    connections: RefCell<Vec<Rc<Connection>>>,
    address: SocketAddr,
}

/// The place of a connection, which is free again when this is dropped, by a panic too.
struct Place {
    server: Rc<Server>,
    connection: Rc<Connection>,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.server.connections.borrow_mut().retain(|other| !Rc::ptr_eq(other, &self.connection));
    }
}

/// What is known of a connection.
struct Connection {
    peer: SocketAddr,
    /// When it last requested or took something.
    last: Cell<Instant>,
    /// It waits for an answer of the run.
    waits: Cell<bool>,
    /// The last request for something of the rig was admitted.
    is_let_in: Cell<bool>,
    /// Another one has its place.
    gives_way: Notify,
}

impl Server {
    /// `address` is that of the links.
    pub(super) fn new(door: Door, address: SocketAddr, board: Arc<Board>, ask: Asker) -> Self {
        let (rates, pictures, connections) = Default::default();
        Self { door, board, ask, views: watch::channel("".into()).0, rates, pictures, connections, address }
    }

    /// Serves until the future is dropped. In a `LocalSet`.
    pub(super) async fn serve(self: Rc<Self>, listener: TcpListener) {
        // Neither ends.
        tokio::join!(self.watch(), self.accept(listener));
    }

    async fn accept(self: &Rc<Self>, listener: TcpListener) {
        loop {
            let Ok((stream, peer)) = listener.accept().await else {
                sleep(PAUSE).await;
                continue;
            };
            let is_full = self.connections.borrow().len() >= CONNECTIONS;
            if is_full && !self.give_way() {
                // Not by tokio, which has not heard yet that it can be written to. What does not fit is left out.
                let _ = stream.into_std().and_then(|mut stream| stream.write_all(FULL));
                continue;
            }
            // From now on, and not from when its task first runs.
            let connection = Rc::new(Connection::new(peer));
            self.connections.borrow_mut().push(Rc::clone(&connection));
            let place = Place { server: Rc::clone(self), connection };
            spawn_local(Rc::clone(self).connect(stream, place));
        }
    }

    /// Frees the place of one that is not let in: of the address that has most of them, the oldest. Whether there is one.
    fn give_way(&self) -> bool {
        let mut connections = self.connections.borrow_mut();
        let strangers = connections.iter().enumerate().rev().filter(|(_, connection)| !connection.is_let_in.get());
        let as_many = |(_, connection): &(usize, &Rc<Connection>)| {
            let is_like = |other: &&Rc<Connection>| other.peer.ip() == connection.peer.ip() && !other.is_let_in.get();
            connections.iter().filter(is_like).count()
        };
        // The last of equals.
        let Some((number, _)) = strangers.max_by_key(as_many) else { return false };
        connections.remove(number).gives_way.notify_one();
        true
    }

    async fn connect(self: Rc<Self>, stream: TcpStream, place: Place) {
        let connection = Rc::clone(&place.connection);
        let service = service_fn(|request| {
            let (server, connection) = (Rc::clone(&self), Rc::clone(&connection));
            async move { Ok::<_, Infallible>(server.answer(&connection, request).await) }
        });
        // Small messages, each of which is waited for.
        let _ = stream.set_nodelay(true);
        let served = http1::Builder::new().max_buf_size(LONGEST_HEAD).serve_connection(TokioIo::new(stream), service);
        tokio::select! {
            // What is not HTTP, or a client that has gone, is not an error of the run.
            _ = served => {}
            () = connection.stuck() => {}
            () = connection.gives_way.notified() => {}
        }
    }

    /// Looks at the board while a page is open.
    async fn watch(&self) {
        let mut turns = interval(TURN);
        turns.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            turns.tick().await;
            fault::point("web");
            if let Some(token) = self.door.token.as_ref().and_then(Source::look) {
                super::renewed(&self.board, self.address, &token);
            }
            if self.views.receiver_count() > 0 {
                self.update_views();
            } else {
                self.rates.take();
            }
        }
    }

    fn update_views(&self) {
        let snapshot = self.board.snapshot();
        let mut rates = self.rates.borrow_mut();
        rates.update(&snapshot);
        // Its types have nothing that JSON refuses.
        let text = text::json(&View::new(&snapshot, &rates, &self.board.cameras())).unwrap_or_default();
        self.views.send_if_modified(|view| {
            let is_new = **view != *text;
            if is_new {
                *view = text.into();
            }
            is_new
        });
    }

    async fn answer(self: &Rc<Self>, connection: &Rc<Connection>, request: Request<Incoming>) -> Response<Outgoing> {
        connection.last.set(Instant::now());
        let answered = self.route(connection, request).await;
        let mut response = answered.unwrap_or_else(|(status, text)| whole(status, "text/plain; charset=utf-8", text));
        let headers = response.headers_mut();
        for (name, value) in HEADERS {
            headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
        }
        response
    }

    async fn route(
        self: &Rc<Self>,
        connection: &Rc<Connection>,
        request: Request<Incoming>,
    ) -> Result<Response<Outgoing>, Refusal> {
        const NONE: Refusal = (StatusCode::NOT_FOUND, "there is no such page");
        let path = request.uri().path().to_owned();
        let page = PAGE.iter().find(|(name, ..)| *name == path);
        let asked = match (page, &*path) {
            (Some(_), _) => Asked::Page,
            (None, "/enter") => Asked::Entry,
            (None, _) => Asked::Rig,
        };
        let admitted = self.door.admit(asked, request.method(), request.headers());
        if asked == Asked::Rig {
            connection.is_let_in.set(admitted.is_ok());
        }
        admitted?;
        let is_post = matches!(&*path, "/enter" | "/do");
        if request.method() != if is_post { Method::POST } else { Method::GET } {
            return Err((StatusCode::METHOD_NOT_ALLOWED, "this is requested by another method"));
        }
        if let Some((_, kind, text)) = page {
            return Ok(whole(StatusCode::OK, kind, *text));
        }
        match &*path {
            "/enter" => self.enter(request).await,
            "/events" => Ok(self.events(connection, request.into_parts().0.headers)),
            "/do" => self.obey(connection, request).await,
            _ => {
                let bit = path.strip_prefix("/picture/").and_then(|bit| bit.parse().ok()).and_then(ModalityId::new);
                let after = request.uri().query().and_then(|query| query.strip_prefix("after="));
                self.picture(bit.ok_or(NONE)?, after.and_then(|after| after.parse().ok()))
            }
        }
    }

    async fn enter(&self, request: Request<Incoming>) -> Result<Response<Outgoing>, Refusal> {
        let has_token = self.door.has_token(request.headers());
        let body = body(request).await?;
        let cookie = std::str::from_utf8(&body).ok().and_then(|shown| self.door.cookie(shown));
        let mut response = whole(StatusCode::NO_CONTENT, "text/plain", "");
        match cookie.and_then(|cookie| HeaderValue::from_str(&cookie).ok()) {
            Some(cookie) => drop(response.headers_mut().insert(SET_COOKIE, cookie)),
            // Who has entered with the right one, or needs none, may show anything.
            None if has_token => {}
            None => return Err(NO_TOKEN),
        }
        Ok(response)
    }

    /// Views until the connection ends. A client that reads slowly gets fewer of them.
    fn events(self: &Rc<Self>, connection: &Rc<Connection>, headers: HeaderMap) -> Response<Outgoing> {
        self.update_views();
        let mut views = self.views.subscribe();
        views.mark_changed();
        let (to, frames) = mpsc::channel(1);
        let (server, connection) = (Rc::clone(self), Rc::clone(connection));
        spawn_local(async move {
            let mut beats = interval(BEAT);
            beats.set_missed_tick_behavior(MissedTickBehavior::Delay);
            loop {
                let event = tokio::select! {
                    biased;
                    changed = views.changed() => match changed {
                        Ok(()) => format!("event: view\ndata: {}", *views.borrow_and_update()),
                        Err(_) => return,
                    },
                    _ = beats.tick() => "event: beat\ndata: 1".to_owned(),
                };
                if !server.door.has_token(&headers) {
                    return connection.is_let_in.set(false);
                }
                // By its time a page finds out that it reads an old one.
                let ms = Stamp::now().0 / 1_000_000;
                if to.send(format!("id: {ms}\n{event}\n\n").into()).await.is_err() {
                    return;
                }
                connection.last.set(Instant::now());
            }
        });
        response(StatusCode::OK, "text/event-stream", Outgoing::Events(frames))
    }

    fn picture(&self, device: ModalityId, after: Option<u64>) -> Result<Response<Outgoing>, Refusal> {
        if !self.board.cameras().contains(&device) {
            return Err((StatusCode::NOT_FOUND, "there is no camera with this bit"));
        }
        let now = Stamp::now();
        self.board.look(device, now);
        let preview = self.board.newest_preview(device).filter(|preview| Some(preview.seq) != after);
        let Some(preview) = preview else { return Ok(whole(StatusCode::NO_CONTENT, "image/jpeg", "")) };
        let jpeg = self.pictures.borrow_mut().jpeg(&preview);
        let jpeg = jpeg.map_err(|_| (StatusCode::UNPROCESSABLE_ENTITY, "the picture is damaged"))?;
        let mut response = whole(StatusCode::OK, "image/jpeg", jpeg);
        let age = now.since(preview.captured).as_millis();
        for (name, value) in [("x-seq", preview.seq.to_string()), ("x-age-ms", age.to_string())] {
            // Digits.
            let value = HeaderValue::from_str(&value).unwrap_or(HeaderValue::from_static("0"));
            response.headers_mut().insert(HeaderName::from_static(name), value);
        }
        Ok(response)
    }

    async fn obey(&self, connection: &Connection, request: Request<Incoming>) -> Result<Response<Outgoing>, Refusal> {
        const NOT_HERE: Refusal = (StatusCode::FORBIDDEN, "the page does not request this");
        let body = body(request).await?;
        let wanted: SessionRequest = serde_json::from_slice(&body)
            .map_err(|_| (StatusCode::BAD_REQUEST, "this is not a request to the session"))?;
        if !is_offered(&wanted) {
            return Err(NOT_HERE);
        }
        let (reply, answer) = oneshot::channel();
        let shown = serde_json::to_string(&wanted).unwrap_or_default();
        (self.ask)(wanted, reply);
        connection.waits.set(true);
        let answer = answer.await.unwrap_or_else(|_| Err("the run is ending".to_owned()));
        connection.waits.set(false);
        connection.last.set(Instant::now());
        let (Ok(text) | Err(text)) = &answer;
        tracing::info!("page: {} requested {shown}: {text}", connection.peer.ip());
        let json = serde_json::json!({ "text": text, "refused": answer.is_err() }).to_string();
        Ok(whole(StatusCode::OK, "application/json", json))
    }
}

/// What a page may request. A discard names its episode: a press that arrives late discards no other.
const fn is_offered(request: &SessionRequest) -> bool {
    match request {
        SessionRequest::Start
        | SessionRequest::Stop
        | SessionRequest::Undo
        | SessionRequest::Mark { .. }
        | SessionRequest::Discard { episode: Some(_) }
        | SessionRequest::Label { episode: Some(_), .. } => true,
        SessionRequest::Toggle
        | SessionRequest::Next
        | SessionRequest::Redo
        | SessionRequest::Discard { episode: None }
        | SessionRequest::Label { episode: None, .. }
        | SessionRequest::Note { .. }
        | SessionRequest::Plan { .. }
        | SessionRequest::EndSession
        | SessionRequest::Show => false,
    }
}

impl Connection {
    /// From `peer`, now.
    fn new(peer: SocketAddr) -> Self {
        let (last, gives_way) = (Cell::new(Instant::now()), Notify::new());
        Self { peer, last, waits: Cell::new(false), is_let_in: Cell::new(false), gives_way }
    }

    /// Returns when it has been [`STUCK`].
    async fn stuck(&self) {
        loop {
            let until = self.last.get() + STUCK;
            if until <= Instant::now() && !self.waits.get() {
                return;
            }
            sleep_until(until.max(Instant::now() + BEAT)).await;
        }
    }
}

/// The body of a request.
async fn body(request: Request<Incoming>) -> Result<Bytes, Refusal> {
    let body = Limited::new(request.into_body(), LONGEST_BODY).collect().await;
    body.map(Collected::to_bytes).map_err(|_| (StatusCode::PAYLOAD_TOO_LARGE, "the request is cut off, or too long"))
}

fn whole(status: StatusCode, kind: &'static str, body: impl Into<Bytes>) -> Response<Outgoing> {
    response(status, kind, Outgoing::Whole(Some(body.into())))
}

fn response(status: StatusCode, kind: &'static str, body: Outgoing) -> Response<Outgoing> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    response
}

/// The body of an answer.
enum Outgoing {
    Whole(Option<Bytes>),
    Events(mpsc::Receiver<Bytes>),
}

impl Body for Outgoing {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let data = match &mut *self {
            Self::Whole(bytes) => Poll::Ready(bytes.take()),
            Self::Events(frames) => frames.poll_recv(cx),
        };
        data.map(|data| data.map(|data| Ok(Frame::data(data))))
    }

    fn is_end_stream(&self) -> bool {
        match self {
            Self::Whole(bytes) => bytes.as_ref().is_none_or(Bytes::is_empty),
            Self::Events(_) => false,
        }
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(bytes) => SizeHint::with_exact(bytes.as_ref().map_or(0, |bytes| bytes.len() as u64)),
            Self::Events(_) => SizeHint::default(),
        }
    }
}
