//! A page, simulated by bytes on a socket.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// A picture of what is around the origin.
pub const SHOT: &str = r#"{"do":"shot","id":1,"position":[0,0,-4],"rotation":[1,0,0,0],"width":64,"height":48,"fx":50,"fy":50,"cx":32,"cy":24}"#;

/// More bytes than any request may have.
pub const TOO_LARGE: usize = (16 << 20) + 1;

/// A connection to the server.
pub fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).expect("connected");
    let limit = Some(Duration::from_secs(60));
    stream.set_read_timeout(limit).expect("a limit");
    stream.set_write_timeout(limit).expect("a limit");
    stream
}

/// The address of a viewer on this machine.
pub fn address_of(printed: &str) -> SocketAddr {
    let host = printed.trim_start_matches("http://");
    let end = host.find('/').expect("a path");
    let port = host[..end].rsplit_once(':').expect("a port").1;
    SocketAddr::from(([127, 0, 0, 1], port.parse().expect("a number")))
}

pub struct Socket(pub TcpStream);

impl Socket {
    /// Connects and completes the handshake.
    pub fn open(address: SocketAddr) -> Self {
        let mut stream = connect(address);
        let request = format!(
            "GET /socket HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).expect("sent");
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).expect("a head");
            head.push(byte[0]);
        }
        assert!(head.starts_with(b"HTTP/1.1 101"), "{}", String::from_utf8_lossy(&head));
        Self(stream)
    }

    /// Sends a masked frame; returns whether the connection was still open.
    pub fn send(&mut self, opcode: u8, payload: &[u8]) -> bool {
        let mut frame = vec![0x80 | opcode];
        match payload.len() {
            len @ ..=125 => frame.push(0x80 | len as u8),
            len @ ..=0xffff => {
                frame.push(0x80 | 126);
                frame.extend((len as u16).to_be_bytes());
            }
            len => {
                frame.push(0x80 | 127);
                frame.extend((len as u64).to_be_bytes());
            }
        }
        // A mask of zeros.
        frame.extend([0; 4]);
        frame.extend(payload);
        self.0.write_all(&frame).is_ok()
    }

    /// The next message; `None` when the connection has ended.
    pub fn receive(&mut self) -> Option<(u8, Vec<u8>)> {
        let mut head = [0; 2];
        self.read(&mut head)?;
        let mut long = [0; 8];
        let len = match head[1] & 0x7f {
            126 => {
                self.read(&mut long[6..])?;
                u64::from_be_bytes(long)
            }
            127 => {
                self.read(&mut long)?;
                u64::from_be_bytes(long)
            }
            len => u64::from(len),
        };
        let mut payload = vec![0; len as usize];
        self.read(&mut payload)?;
        Some((head[0] & 0xf, payload))
    }

    fn read(&mut self, to: &mut [u8]) -> Option<()> {
        match self.0.read_exact(to) {
            Ok(()) => Some(()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                panic!("the server neither answers nor ends the connection")
            }
            Err(_) => None,
        }
    }

    /// Whether the server ends the connection.
    pub fn is_ended(&mut self) -> bool {
        loop {
            match self.receive() {
                Some((8, _)) | None => return true,
                Some(_) => {}
            }
        }
    }
}
