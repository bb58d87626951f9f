//! A viewer in any browser: for splats and radiance fields, after training and while it runs.
//!
//! ```no_run
//! use irradia_viewer::{Listen, Subject, Viewer};
//!
//! let subject = Subject::open("run".as_ref(), None, &Default::default())?;
//! let viewer = Viewer::start(subject, &Listen::default(), Box::new(|line| eprintln!("{line}")))?;
//! println!("{}", viewer.address());
//! viewer.wait(&|| false);
//! # Ok::<(), irradia_viewer::ViewerError>(())
//! ```
//!
//! | file | idea |
//! |---|---|
//! | `subject.rs`, `views.rs`, `live.rs` | what is shown: a scene, its photographs, a training |
//! | `scheduler.rs`, `pace.rs`, `draw.rs` | which pictures pages request, when they are drawn, at which size |
//! | `levels.rs` | which level of detail a moving camera gets |
//! | `paint.rs`, `palette.rs` | a camera's picture: colours, depth, normals, counts, ellipses, errors |
//! | `editing/` | selections and edits of a finished scene, which all pages share |
//! | `compact.rs`, `importance.rs` | the format of splats for browsers that draw them, most important first |
//! | `kernels.rs` | the program's compute shaders, for browsers with WebGPU |
//! | `share.rs` | a scene as one page, or a folder for a web server |
//! | `listen.rs`, `guard.rs`, `serve.rs`, `page.rs` | addresses, access control, and routes |
//! | `client.rs`, `message.rs` | the socket of one page |
//!
//! The page itself is in `page/`: plain modules, styles and shaders, embedded as they are.
#![forbid(unsafe_code)]

mod client;
mod compact;
mod draw;
mod editing;
mod error;
mod guard;
mod importance;
mod kernels;
mod levels;
mod listen;
mod live;
mod message;
mod notices;
mod pace;
mod page;
mod paint;
mod palette;
mod scheduler;
mod serve;
mod share;
mod subject;
mod viewer;
mod views;

pub use error::ViewerError;
pub use listen::{DEFAULT_PORT, Listen};
pub use live::Watcher;
pub use notices::LineSink;
pub use share::{ShareOptions, Shared, share};
pub use subject::Subject;
pub use viewer::Viewer;
