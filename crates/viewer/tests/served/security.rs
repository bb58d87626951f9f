//! Hostile clients: refused, reported once, and without effect on others.

use crate::client::{SHOT, Socket, TOO_LARGE, address_of, connect};
use irradia_runs::formats::write_splats;
use irradia_scene::GaussianCloud;
use irradia_viewer::{Listen, Subject, Viewer};
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A viewer, and the lines that it reported.
pub struct Served {
    viewer: Viewer,
    reported: Arc<Mutex<Vec<String>>>,
    scene: PathBuf,
    _folder: Option<TempDir>,
}

/// A viewer of three splats.
pub fn serve(host: &str) -> Served {
    let folder = tempfile::tempdir().expect("a folder");
    let ply = folder.path().join("scene.ply");
    let cloud = GaussianCloud {
        means: vec![[-1.0, 0.0, 0.0], [0.0; 3], [1.0, 0.0, 0.0]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
        log_scales: vec![[-1.0; 3]; 3],
        opacity_logits: vec![4.0; 3],
        sh: vec![1.0; 9],
        sh_degree: 0,
        antialiased: false,
        ..Default::default()
    };
    write_splats(&ply, &cloud).expect("written");
    Served {
        _folder: Some(folder),
        ..Served::of(&ply, host)
    }
}

impl Served {
    /// A viewer of `scene`.
    pub fn of(scene: &Path, host: &str) -> Self {
        let subject = Subject::open(scene, None, &Default::default()).expect("a scene");
        let reported = Arc::new(Mutex::new(Vec::new()));
        let tell = {
            let reported = reported.clone();
            move |line: &str| reported.lock().expect("no panic").push(line.to_owned())
        };
        let listen = Listen {
            host: host.to_owned(),
            port: 0,
            open: false,
        };
        Self {
            viewer: Viewer::start(subject, &listen, Box::new(tell)).expect("a server"),
            reported,
            scene: scene.to_owned(),
            _folder: None,
        }
    }

    /// The file of the scene.
    pub fn scene(&self) -> &Path {
        &self.scene
    }

    fn address(&self) -> SocketAddr {
        address_of(self.viewer.address())
    }

    fn connect(&self) -> TcpStream {
        connect(self.address())
    }

    /// The response to a request with these lines after the first.
    fn get(&self, target: &str, headers: &[&str]) -> String {
        let mut stream = self.connect();
        let lines: String = headers.iter().map(|line| format!("{line}\r\n")).collect();
        let request = format!("GET {target} HTTP/1.1\r\n{lines}Connection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).expect("sent");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    pub fn host(&self) -> String {
        format!("Host: {}", self.address())
    }

    /// The response to sending a scene.
    pub fn send_scene(&self, target: &str, origin: &str, scene: &[u8]) -> String {
        let mut stream = self.connect();
        let host = self.host();
        let length = scene.len();
        let head = format!(
            "POST {target} HTTP/1.1\r\n{host}\r\nOrigin: {origin}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).expect("sent");
        let _ = stream.write_all(scene);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    pub fn origin(&self) -> String {
        format!("http://{}", self.address())
    }

    pub fn status(&self, target: &str, headers: &[&str]) -> u32 {
        let answer = self.get(target, headers);
        let status = answer.split_whitespace().nth(1).and_then(|status| status.parse().ok());
        status.unwrap_or_else(|| panic!("no status: {answer:?}"))
    }

    /// Number of reported lines that contain `part`.
    fn reported(&self, part: &str) -> usize {
        self.reported
            .lock()
            .expect("no panic")
            .iter()
            .filter(|line| line.contains(part))
            .count()
    }

    pub fn socket(&self) -> Socket {
        Socket::open(self.address())
    }

    /// Asserts that a page still gets a picture.
    pub fn assert_draws(&self) {
        let mut page = self.socket();
        page.send(1, SHOT.as_bytes());
        let started = Instant::now();
        while started.elapsed() < Duration::from_secs(60) {
            if let Some((2, picture)) = page.receive() {
                let header = u32::from_le_bytes(picture[..4].try_into().expect("four bytes")) as usize;
                assert!(picture[4 + header..].starts_with(&[0xff, 0xd8]), "a JPEG");
                return;
            }
        }
        panic!("no picture");
    }
}

#[test]
fn only_its_own_page_is_answered() {
    let served = serve("127.0.0.1");
    let host = served.host();
    assert_eq!(served.status("/", &[&host]), 200);
    for (target, headers) in [
        ("/", vec!["Host: evil.example"]),
        ("/", vec!["Host: evil.example:80", "Host: localhost"]),
        ("/socket", vec![host.as_str(), "Origin: http://evil.example"]),
        ("/splats", vec![host.as_str(), "Origin: null"]),
        (
            "/view/0/photo",
            vec![host.as_str(), "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"],
        ),
    ] {
        assert_eq!(served.status(target, &headers), 403, "{target} {headers:?}");
    }
    assert_eq!(served.status("/", &[]), 403, "no host");
    assert_eq!(
        (served.reported("Host"), served.reported("another site")),
        (1, 1),
        "each reason once"
    );
    let head = served.get("/", &[&host]).to_lowercase();
    for header in [
        "content-security-policy: default-src 'self'",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
    ] {
        assert!(head.contains(header), "{header}");
    }
    served.assert_draws();
}

#[test]
fn paths_lead_nowhere_but_to_the_page() {
    let served = serve("127.0.0.1");
    let host = served.host();
    assert_eq!(served.status("/page/js/main.js", &[&host]), 200);
    for target in [
        "/page/../Cargo.toml",
        "/page/..%2f..%2fCargo.toml",
        "/page/%2e%2e/%2e%2e/etc/passwd",
        "/page//etc/passwd",
        "/page/js/../../src/lib.rs",
        "/page/js/main.js%00.css",
        "/scene.ply",
        "/view/-1/photo",
        "/view/99999999999999999999/photo",
        "/view/0/photo",
        "/view/../../photo",
    ] {
        let answer = served.get(target, &[&host]);
        let status = answer.split_whitespace().nth(1).unwrap_or_default().to_owned();
        assert!(status == "404" || status == "400", "{target}: {status}");
    }
    assert_eq!(served.status("/../../etc/passwd", &[&host]), 404);
}

#[test]
fn beyond_loopback_the_token_is_needed() {
    let served = serve("0.0.0.0");
    let (_, token) = served.viewer.address().split_once("token=").expect("a token");
    let host = served.host();
    assert_eq!(served.status("/", &[&host]), 403);
    assert_eq!(served.status("/socket?token=0", &[&host]), 403);
    assert_eq!(served.status("/page/js/main.js", &[&host, "Cookie: token=1"]), 403);
    assert_eq!(served.reported("token"), 1);
    let first = served.get(&format!("/?token={token}"), &[&host]);
    let cookie = first
        .lines()
        .find(|line| line.to_lowercase().starts_with("set-cookie:"))
        .expect("a cookie");
    assert!(
        cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"),
        "{cookie}"
    );
    let sent = cookie.split_once(": ").and_then(|(_, value)| value.split(';').next());
    let sent = format!("Cookie: {}", sent.expect("a value"));
    assert_eq!(served.status("/page/js/main.js", &[&host, &sent]), 200);
    // A browser sends both cookies to both ports of a host.
    let other = serve("0.0.0.0");
    let (_, token) = other.viewer.address().split_once("token=").expect("a token");
    let host = other.host();
    let second = other.get(&format!("/?token={token}"), &[&host]);
    let name = |head: &str| {
        head.lines().find_map(|line| {
            line.to_lowercase()
                .strip_prefix("set-cookie: ")?
                .split('=')
                .next()
                .map(str::to_owned)
        })
    };
    assert!(name(&first).is_some() && name(&first) != name(&second));
}

#[test]
fn garbage_and_giants_end_their_own_connection_only() {
    let served = serve("127.0.0.1");
    let mut giant = served.socket();
    giant.send(1, &vec![b' '; TOO_LARGE]);
    assert!(giant.is_ended(), "an oversized frame");

    let mut liar = served.socket();
    // A length of 2^60 bytes.
    let _ = liar.0.write_all(&[0x81, 0xff, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    assert!(liar.is_ended(), "a frame that claims to be huge");

    let mut babbler = served.socket();
    for text in ["", "{", "{\"do\":\"fly\"}", "[1]", "null"]
        .into_iter()
        .cycle()
        .take(400)
    {
        if !babbler.send(1, text.as_bytes()) {
            break;
        }
    }
    assert!(babbler.is_ended(), "garbage");

    let mut noise = served.connect();
    let _ = noise.write_all(&[0xff; 5000]);
    let mut answer = Vec::new();
    let ended = noise.read_to_end(&mut answer);
    assert!(
        ended.is_ok() || ended.is_err_and(|e| e.kind() == ErrorKind::ConnectionReset),
        "no HTTP"
    );
    assert!(served.reported("was disconnected") <= 1 && served.reported("protocol") <= 1);
    served.assert_draws();
}

#[test]
fn a_thousand_connections_do_not_stop_the_server() {
    let served = serve("127.0.0.1");
    let held: Vec<TcpStream> = (0..1000)
        .filter_map(|_| TcpStream::connect_timeout(&served.address(), Duration::from_secs(5)).ok())
        .collect();
    assert!(held.len() > 100);
    drop(held);
    let started = Instant::now();
    let host = served.host();
    // The server needs a moment to see that they are gone.
    loop {
        let mut stream = served.connect();
        let mut answer = String::new();
        let request = format!("GET / HTTP/1.1\r\n{host}\r\nConnection: close\r\n\r\n");
        let _ = stream.write_all(request.as_bytes());
        let _ = stream.read_to_string(&mut answer);
        if answer.starts_with("HTTP/1.1 200") {
            break;
        }
        assert!(started.elapsed() < Duration::from_secs(60), "no answer");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(served.reported("connections") <= 1);
    served.assert_draws();
}

#[test]
fn pages_beyond_the_limit_are_sent_away_until_one_leaves() {
    let served = serve("127.0.0.1");
    let mut pages: Vec<Socket> = (0..8).map(|_| served.socket()).collect();
    for page in &mut pages {
        assert!(
            page.receive().is_some_and(|(_, hello)| hello.starts_with(b"{")),
            "a seat"
        );
    }
    assert!(served.socket().is_ended());
    assert_eq!(served.reported("pages"), 1);
    pages.clear();
    let started = Instant::now();
    while served.viewer.is_watched() && started.elapsed() < Duration::from_secs(30) {
        std::thread::sleep(Duration::from_millis(20));
    }
    served.assert_draws();
}
