//! The server as seen by well-behaved and hostile clients.

mod client;
mod editing;
mod live;
mod pictures;
mod security;
