//! HTTP for devices: one request per connection, every wait and every size bounded.

use std::time::Duration;

use http_body_util::{BodyExt, Empty};
use hyper::body::{Bytes, Incoming};
use hyper::client::conn::http1;
use hyper::header::{CONNECTION, HOST, HeaderMap, HeaderName, RANGE};
use hyper::{Request, StatusCode};
use hyper_util::rt::TokioIo;
use tokio::time::timeout;
use tokio_util::task::AbortOnDropHandle;

use super::address::Server;
use crate::driver::DriverError;

/// Maximum bytes of a reply's headers.
const LONGEST_HEAD: usize = 16 << 10;

/// The head of a reply; its body follows.
#[derive(Debug)]
pub(super) struct Reply {
    server: Server,
    pub(super) status: StatusCode,
    headers: HeaderMap,
    body: Incoming,
    /// The task that handles the connection; it ends when this is dropped.
    _connection: AbortOnDropHandle<()>,
}

/// Requests `path`, from byte `from` on if that is not 0.
pub(super) async fn get(server: &Server, path: &str, from: u64, limit: Duration) -> Result<Reply, DriverError> {
    let ask = async {
        let stream = server.connect().await?;
        let odd = |error: hyper::Error| server.place.lost(format_args!("its answer is not HTTP: {}", causes(&error)));
        // Known mistakes of cameras' servers are tolerated.
        let (mut sender, connection) = http1::Builder::new()
            .max_buf_size(LONGEST_HEAD)
            .ignore_invalid_headers_in_responses(true)
            .allow_spaces_after_header_name_in_responses(true)
            .handshake(TokioIo::new(stream))
            .await
            .map_err(odd)?;
        let connection = AbortOnDropHandle::new(tokio::spawn(async move {
            // The reader of the body gets the error.
            let _ = connection.await;
        }));
        let mut request = Request::get(path).header(HOST, server.address.to_string()).header(CONNECTION, "close");
        if from > 0 {
            request = request.header(RANGE, format!("bytes={from}-"));
        }
        let request = request.body(Empty::<Bytes>::new());
        let request = request.map_err(|error| DriverError::Fatal(format!("{path:?} cannot be asked for: {error}")))?;
        let reply = sender.send_request(request).await.map_err(odd)?;
        server.place.received();
        let (head, body) = reply.into_parts();
        let server = server.clone();
        Ok(Reply { server, status: head.status, headers: head.headers, body, _connection: connection })
    };
    match timeout(limit, ask).await {
        Ok(reply) => reply,
        Err(_) => Err(server.place.lost(format_args!("no answer to {path} within {} s", limit.as_secs()))),
    }
}

/// The whole body of a successful answer, at most `most` bytes.
pub(super) async fn text(server: &Server, path: &str, most: usize, limit: Duration) -> Result<Vec<u8>, DriverError> {
    match answer(server, path, most, limit).await? {
        (status, body) if status.is_success() => Ok(body),
        (status, _) => Err(DriverError::Retry(format!("{}: {path}: {status}", server.place))),
    }
}

/// The status and the whole body of an answer, bounded in size.
pub(super) async fn answer(
    server: &Server,
    path: &str,
    most: usize,
    limit: Duration,
) -> Result<(StatusCode, Vec<u8>), DriverError> {
    let fetch = async {
        let mut reply = get(server, path, 0, limit).await?;
        let mut body = Vec::new();
        while let Some(bytes) = reply.next().await? {
            if body.len() + bytes.len() > most {
                return Err(DriverError::Retry(format!("{}: {path}: more than {most} bytes", server.place)));
            }
            body.extend_from_slice(&bytes);
        }
        Ok((reply.status, body))
    };
    match timeout(limit, fetch).await {
        Ok(answer) => answer,
        Err(_) => Err(server.place.lost(format_args!("no answer to {path} within {} s", limit.as_secs()))),
    }
}

impl Reply {
    /// The next bytes of the body; `None` at its end. Cancel-safe.
    pub(super) async fn next(&mut self) -> Result<Option<Bytes>, DriverError> {
        loop {
            match self.body.frame().await {
                Some(Ok(frame)) => {
                    self.server.place.received();
                    // Trailers are ignored.
                    if let Ok(bytes) = frame.into_data() {
                        return Ok(Some(bytes));
                    }
                }
                Some(Err(error)) => {
                    return Err(self.server.place.lost(format_args!("the stream broke: {}", causes(&error))));
                }
                None => return Ok(None),
            }
        }
    }

    /// A header, if it is text.
    pub(super) fn header(&self, name: HeaderName) -> Option<&str> {
        self.headers.get(name)?.to_str().ok()
    }
}

/// An error and its causes.
fn causes(error: &hyper::Error) -> String {
    use std::error::Error as _;
    match error.source() {
        Some(source) => format!("{error}: {source}"),
        None => error.to_string(),
    }
}
