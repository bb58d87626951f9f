//! The address of the server, and its connections.

use crate::ViewerError;
use crate::notices::Notices;
use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, SocketAddr, TcpListener, ToSocketAddrs, UdpSocket};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Notify, Semaphore};

/// The default port.
pub const DEFAULT_PORT: u16 = 7979;
/// Number of ports that are tried after a taken one.
const MAX_PORT_TRIES: u16 = 50;
/// Maximum number of connections; further ones are closed immediately. A page needs up to seven.
const MAX_CONNECTIONS: usize = 96;
/// Time in which a client must send the head of a request.
const HEADER_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum bytes of a request's head.
const MAX_HEADER_BYTES: usize = 16 << 10;

/// Where to listen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen {
    /// An address or a name of this machine. All but loopback require a token.
    pub host: String,
    /// If it is taken, the next free one is used; 0 for any.
    pub port: u16,
    /// Whether to open the page in a browser.
    pub open: bool,
}

impl Default for Listen {
    fn default() -> Self {
        Self {
            host: "127.0.0.1".to_owned(),
            port: DEFAULT_PORT,
            open: false,
        }
    }
}

impl Listen {
    /// Listens on the port, or on the next free one.
    pub(crate) fn bind(&self) -> Result<TcpListener, ViewerError> {
        let failed = |source: io::Error| ViewerError::Listen {
            address: format!("{}:{}", self.host, self.port),
            source,
        };
        let addresses: Vec<SocketAddr> = (self.host.as_str(), self.port)
            .to_socket_addrs()
            .map_err(failed)?
            .collect();
        let last = if self.port == 0 {
            0
        } else {
            self.port.saturating_add(MAX_PORT_TRIES)
        };
        for port in self.port..=last {
            let tried: Vec<SocketAddr> = addresses
                .iter()
                .map(|address| SocketAddr::new(address.ip(), port))
                .collect();
            match TcpListener::bind(&tried[..]) {
                Err(error) if error.kind() == ErrorKind::AddrInUse && port < last => {}
                outcome => return outcome.map_err(failed),
            }
        }
        Err(failed(ErrorKind::AddrInUse.into()))
    }
}

/// The address to print for a server that listens on `bound`.
pub(crate) fn reachable(bound: SocketAddr) -> SocketAddr {
    if !bound.ip().is_unspecified() {
        return bound;
    }
    // The address from which this machine would reach others; nothing is sent.
    let outward = || -> io::Result<IpAddr> {
        let socket = UdpSocket::bind("0.0.0.0:0")?;
        socket.connect("192.0.2.1:9")?;
        Ok(socket.local_addr()?.ip())
    };
    let loopback = IpAddr::from([127, 0, 0, 1]);
    SocketAddr::new(outward().unwrap_or(loopback), bound.port())
}

/// Serves `router` until told to close.
pub(crate) async fn accept(
    listener: TcpListener,
    router: Router,
    notices: Arc<Notices>,
    closing: Arc<Notify>,
) -> io::Result<()> {
    listener.set_nonblocking(true)?;
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let free = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = closing.notified() => return Ok(()),
        };
        let Ok((stream, _)) = accepted else {
            // Out of file descriptors, for example: others may be closed soon.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let Ok(permit) = free.clone().try_acquire_owned() else {
            notices.report_once(
                "connections",
                format_args!("more than {MAX_CONNECTIONS} connections: further ones are closed"),
            );
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new())
                .header_read_timeout(HEADER_TIMEOUT)
                .max_buf_size(MAX_HEADER_BYTES);
            // A broken connection is the client's problem.
            let _ = http
                .serve_connection(TokioIo::new(stream), service)
                .with_upgrades()
                .await;
            drop(permit);
        });
    }
}

/// Starts the system's browser with the page, if there is one.
pub(crate) fn open_browser(address: &str) -> io::Result<()> {
    let (program, arguments): (&str, &[&str]) = match std::env::consts::OS {
        "windows" => ("cmd", &["/c", "start", ""]),
        "macos" => ("open", &[]),
        _ => ("xdg-open", &[]),
    };
    let null = std::process::Stdio::null;
    let mut command = std::process::Command::new(program);
    command
        .args(arguments)
        .arg(address)
        .stdin(null())
        .stdout(null())
        .stderr(null());
    command.spawn().map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taken_port_gives_the_next_free_one() {
        let first = Listen {
            port: 0,
            ..Listen::default()
        }
        .bind()
        .expect("a port");
        let port = first.local_addr().expect("bound").port();
        let second = Listen {
            port,
            ..Listen::default()
        }
        .bind()
        .expect("another port");
        let other = second.local_addr().expect("bound").port();
        assert!(other > port && other <= port.saturating_add(MAX_PORT_TRIES));
    }

    #[test]
    fn an_address_of_another_machine_is_refused_in_one_line() {
        let elsewhere = Listen {
            host: "192.0.2.1".into(),
            ..Listen::default()
        };
        let error = elsewhere.bind().expect_err("not ours").to_string();
        assert!(
            error.starts_with("cannot listen on 192.0.2.1:7979: ") && !error.contains('\n'),
            "{error}"
        );
    }
}
