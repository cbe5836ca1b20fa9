//! A page for the phone beside the gripper: the bits, pictures, the verdict so far, and large buttons to start, end,
//! discard and label an episode.
//!
//! Thread `web` has everything: the server with its connections, and the encoder of small pictures. It sees what a screen
//! sees, the board, and requests what a screen may request. It has a port of its own: Foxglove's has no
//! token, and answers websockets and nothing else.
//!
//! Invariant: nothing else waits for this thread: a client that reads slowly gets fewer views, and one that does not read
//! is left (`serve`).
//! Invariant: motors are neither armed nor disarmed by it: what stops motion must not depend on a radio.
//! Invariant: whatever ends the thread, the run continues.

mod door;
mod links;
#[cfg(test)]
#[path = "../../tests/support/literal.rs"]
mod literal;
mod pictures;
mod serve;
mod token;
mod view;

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::thread::JoinHandle;

use rustix::net::sockopt::set_socket_send_buffer_size;
use tokio::task::LocalSet;
use tokio_util::sync::CancellationToken;

use door::Door;
use rapid_status::session::Asker;
use rapid_status::{Board, EventKind, Level};
use serve::Server;
pub use token::TokenError;
use token::{Source, Token};

/// Bytes that the kernel holds for one client, at most; more would be old when it reads on.
const SEND_BUFFER: usize = 64 << 10;
/// Niceness: everything else on the machine comes first.
const NICE: i32 = 10;

/// Where the page is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WebOptions {
    /// Its address; with port 0 a free one is chosen.
    pub address: SocketAddr,
    /// Where the token is kept, so that links remain valid. Without it there is a new one at each start, and none on a
    /// loopback address.
    pub token: Option<PathBuf>,
}

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// The address cannot be listened on.
    #[error("--web {address}: {source}{}", fix(source))]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The error of the system.
        source: io::Error,
    },
    /// The token.
    #[error(transparent)]
    Token(#[from] TokenError),
    /// The system provides no thread, or no runtime.
    #[error("--web: {0}")]
    System(#[from] io::Error),
}

fn fix(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AddrInUse => {
            ": another program listens there, perhaps another rapid; end it, or name another port: --web 127.0.0.1:8776"
        }
        io::ErrorKind::AddrNotAvailable => ": this machine has no such address; `ip address` lists those that it has",
        io::ErrorKind::PermissionDenied => ": ports below 1024 are for root; name another",
        _ => "",
    }
}

/// A server that listens, and its thread.
#[derive(Debug)]
pub struct Web {
    thread: Option<JoinHandle<()>>,
    stop: CancellationToken,
    ended: CancellationToken,
    board: Arc<Board>,
}

impl Web {
    /// Serves the page of `board`; what it requests goes to `ask`. The board has the links from then on.
    ///
    /// # Errors
    /// When the address is in use or none of this machine, there is no token, or the system provides no thread.
    pub fn start(options: &WebOptions, board: Arc<Board>, ask: Asker) -> Result<Self, WebError> {
        let failed = |source| WebError::Listen { address: options.address, source };
        let listener = TcpListener::bind(options.address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        // Those of its connections have it too.
        let _ = set_socket_send_buffer_size(&listener, SEND_BUFFER);
        let address = listener.local_addr().map_err(failed)?;
        let token = match &options.token {
            Some(file) => Some(Source::of_file(file)?),
            None if address.ip().is_loopback() => None,
            None => Some(Source::of_run()?),
        };
        announce(&board, address, token.as_ref().and_then(Source::token).as_ref());
        let machine = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let door = Door { token, machine, port: address.port() };
        let (stop, ended) = (CancellationToken::new(), CancellationToken::new());
        let (stopped, guard, shown) = (stop.clone(), ended.clone().drop_guard(), Arc::clone(&board));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let thread = std::thread::Builder::new().name("web".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            // Only less of the processor is a change that no system refuses.
            let _ = rustix::process::setpriority_process(None, NICE);
            let server = Rc::new(Server::new(door, address, shown, ask));
            LocalSet::new().block_on(&runtime, async {
                let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
                tokio::select! {
                    () = stopped.cancelled() => {}
                    () = server.serve(listener) => {}
                }
            });
        })?;
        Ok(Self { thread: Some(thread), stop, ended, board })
    }

    /// Runs until `stop`; then every connection is closed.
    pub async fn run(mut self, stop: CancellationToken) {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.ended.cancelled() => {
                let text = "page: its thread panicked; the run continues without it. Please report this".to_owned();
                self.board.announce(EventKind::Log { level: Level::Error, text });
            }
        }
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            // A panic is reported above.
            let _ = tokio::task::spawn_blocking(move || thread.join()).await;
        }
        stop.cancelled().await;
    }
}

impl Drop for Web {
    fn drop(&mut self) {
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Another token is in force, or none: the board gets its links, and the log says so.
fn renewed(board: &Board, address: SocketAddr, token: &Result<Token, TokenError>) {
    match token {
        Ok(token) => {
            board.set_links(links::links(address, Some(token)));
            let text = "page: the file of --web-token has another token: links and phones of before are locked out; in the \
                        monitor, W shows the new link";
            board.log(Level::Info, text);
        }
        Err(error) => {
            board.set_links(Vec::new());
            board.log(Level::Warn, &format!("page: nobody is let in until this is mended: {error}"));
        }
    }
}

/// The board gets the links; the log, which is recorded and sent to others, does not get the token.
fn announce(board: &Board, address: SocketAddr, token: Option<&Token>) {
    board.set_links(links::links(address, token));
    let text = match token {
        None => format!("page: http://{address}/"),
        Some(_) => format!("page: http://{address}/ with a token: in the monitor, W shows the link as a QR code"),
    };
    board.log(Level::Info, &text);
    if !address.ip().is_loopback() {
        let text = format!(
            "page: {address} can be reached from other machines: whoever has the link sees what the cameras see, and \
             begins, ends and discards episodes; what is sent is not encrypted"
        );
        board.log(Level::Warn, &text);
    }
}
