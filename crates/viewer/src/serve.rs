//! The routes: the page's files, photographs, splats, and the socket. No path of a request names a file.

use crate::compact::compact_in_order;
use crate::draw::encode;
use crate::editing::stem_of;
use crate::guard::{Entry, Guard, UPLOAD_PATH, random_token};
use crate::importance::by_importance;
use crate::message::MAX_REQUEST;
use crate::notices::Notices;
use crate::scheduler::Scheduler;
use crate::subject::{Edition, Subject};
use crate::{client, page};
use axum::Router;
use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{Path, Request, State, WebSocketUpgrade};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, SET_COOKIE,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use irradia_runs::formats::{SplatFormat, encode_splats};
use serde_json::json;
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio::time::timeout;

/// Longer side of a thumbnail, pixels.
const THUMBNAIL_SIDE: u32 = 192;
/// Maximum bytes of thumbnails that are kept.
const MAX_THUMBNAIL_BYTES: usize = 16 << 20;
/// Maximum bytes of a scene that a page sends.
const MAX_UPLOAD_BYTES: usize = 1 << 30;
/// Maximum time to send it.
const UPLOAD_TIMEOUT: Duration = Duration::from_secs(600);
/// JPEG quality of photographs.
const PHOTO_QUALITY: u8 = 90;
/// Maximum number of splats of a scene whose levels of detail are sent too: larger scenes alone fill the textures of many browsers.
const MAX_SPLATS_WITH_LEVELS: usize = 4_000_000;
/// The page loads only what this server serves, and no other page may frame it.
const SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; \
                      base-uri 'none'; form-action 'none'";

/// What all requests share.
pub(crate) struct Shared {
    /// Identifies the scene and its photographs: what a browser has cached for the same address may belong to another scene.
    pub id: String,
    /// Identifies this server, at random: versions of the scene and numbers of selections are counted anew after a restart.
    pub server: String,
    pub subject: Subject,
    pub scheduler: Scheduler,
    pub guard: Guard,
    pub notices: Arc<Notices>,
    /// The compact splats of a version.
    splats: Mutex<Option<(u64, Bytes)>>,
    /// The splats of a version, most important first.
    order: Mutex<Option<(u64, Arc<Vec<u32>>)>>,
    thumbnails: Mutex<HashMap<usize, Bytes>>,
    /// Limits the photographs that are decoded at the same time.
    decoding: Semaphore,
    /// Limits the scenes that are packed at the same time.
    packing: Semaphore,
    /// Limits the scenes that are sent at the same time.
    uploading: Semaphore,
}

/// An identifier that stays the same for a scene and its photographs after a restart, and differs for others.
fn identity(subject: &Subject) -> String {
    let mut hasher = DefaultHasher::new();
    subject.title.hash(&mut hasher);
    subject.views.0.iter().for_each(|view| view.name.hash(&mut hasher));
    if let Some(edition) = subject.edition()
        && let Some(splats) = edition.scene().model.splats()
    {
        let values = (0..3).flat_map(|c| (0..splats.len()).map(move |i| splats.means.get(c, i)));
        values.for_each(|value| value.to_bits().hash(&mut hasher));
    }
    hasher.finish().to_string()
}

impl Shared {
    /// # Errors
    /// When the system refuses random numbers.
    pub fn new(subject: Subject, guard: Guard, notices: Arc<Notices>) -> Result<Self, getrandom::Error> {
        Ok(Self {
            id: identity(&subject),
            server: random_token()?,
            subject,
            scheduler: Scheduler::default(),
            guard,
            notices,
            splats: Mutex::default(),
            order: Mutex::default(),
            thumbnails: Mutex::default(),
            decoding: Semaphore::new(2),
            packing: Semaphore::new(1),
            uploading: Semaphore::new(1),
        })
    }
}

impl Shared {
    /// The splats of a version, most important first.
    fn order(&self, edition: &Edition) -> Option<Arc<Vec<u32>>> {
        let mut kept = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, order)) = kept.as_ref().filter(|(version, _)| *version == edition.splats_version) {
            return Some(order.clone());
        }
        let order = Arc::new(by_importance(edition.scene().model.splats()?));
        *kept = Some((edition.splats_version, order.clone()));
        Some(order)
    }
}

type App = State<Arc<Shared>>;

pub(crate) fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(|| async { page_file("index.html") }))
        .route(
            "/page/{*name}",
            get(|Path(name): Path<String>| async move { page_file(&name) }),
        )
        .route("/splats", get(splats))
        .route("/selection/{version}", get(selection))
        .route("/download/{format}", get(download))
        .route(&format!("{UPLOAD_PATH}{{name}}"), post(upload))
        .route(
            "/view/{view}/photo",
            get(|app: App, Path(view): Path<usize>| photo(app, view, None)),
        )
        .route(
            "/view/{view}/thumbnail",
            get(|app: App, Path(view): Path<usize>| photo(app, view, Some(THUMBNAIL_SIDE))),
        )
        .route("/socket", get(socket))
        .layer(from_fn_with_state(shared.clone(), guarded))
        .with_state(shared)
}

/// Refuses what the guard refuses; adds the headers of every response.
async fn guarded(State(shared): App, request: Request, next: Next) -> Response {
    let entry = shared.guard.check(request.method(), request.uri(), request.headers());
    let mut response = match entry {
        Ok(_) => next.run(request).await,
        Err(refusal) => {
            let reason = refusal.reason();
            shared
                .notices
                .report_once(reason, format_args!("refused a request: {reason}"));
            (StatusCode::FORBIDDEN, reason).into_response()
        }
    };
    let headers = response.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(SECURITY_POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers
        .entry(CACHE_CONTROL)
        .or_insert(HeaderValue::from_static("no-store"));
    if entry == Ok(Entry::ByAddress)
        && let Some(cookie) = shared.guard.cookie()
        && let Ok(cookie) = HeaderValue::try_from(cookie)
    {
        headers.insert(SET_COOKIE, cookie);
    }
    response
}

fn page_file(name: &str) -> Response {
    match page::file(name) {
        Some((kind, text)) => ([(CONTENT_TYPE, kind)], text).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn socket(State(shared): App, upgrade: WebSocketUpgrade) -> Response {
    upgrade
        .max_message_size(MAX_REQUEST)
        .max_frame_size(MAX_REQUEST)
        .on_upgrade(move |socket| client::serve(socket, shared))
}

/// The splats of the newest version in compact form.
async fn splats(State(shared): App) -> Response {
    let Ok(_permit) = shared.packing.acquire().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    let worker = shared.clone();
    let packed = tokio::task::spawn_blocking(move || {
        let edition = worker.subject.edition()?;
        let mut kept = worker.splats.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, bytes)) = kept.as_ref().filter(|(version, _)| *version == edition.splats_version) {
            return Some(bytes.clone());
        }
        let scene = edition.scene();
        let order = worker.order(&edition)?;
        let levels = if order.len() <= MAX_SPLATS_WITH_LEVELS {
            edition.levels.all()
        } else {
            &[]
        };
        let bytes = compact_in_order(scene.model.splats()?, scene.options.sh_degree, &order, levels);
        let bytes = Bytes::from(bytes);
        *kept = Some((edition.splats_version, bytes.clone()));
        Some(bytes)
    });
    match packed.await {
        Ok(Some(bytes)) => ([(CONTENT_TYPE, "application/octet-stream")], Body::from(bytes)).into_response(),
        _ => StatusCode::NOT_FOUND.into_response(),
    }
}

/// Which splats are selected, a bit each in the order of the compact splats of a version, if that is the newest.
async fn selection(State(shared): App, Path(version): Path<u64>) -> Response {
    let packed = tokio::task::spawn_blocking(move || {
        let edition = shared
            .subject
            .edition()
            .filter(|edition| edition.splats_version == version)?;
        let order = shared.order(&edition)?;
        let mut bits = vec![0u8; order.len().div_ceil(8)];
        if let Some(selected) = &edition.selected {
            for (at, _) in order.iter().enumerate().filter(|(_, i)| selected[**i as usize]) {
                bits[at / 8] |= 1 << (at % 8);
            }
        }
        Some(bits)
    });
    match packed.await {
        Ok(Some(bits)) => ([(CONTENT_TYPE, "application/octet-stream")], bits).into_response(),
        _ => StatusCode::NOT_FOUND.into_response(),
    }
}

/// The formats in which a scene can be downloaded, by the name in a request: the extension without its leading dot.
pub(crate) fn downloads() -> impl Iterator<Item = (&'static str, SplatFormat)> {
    let formats = SplatFormat::ALL.into_iter();
    let files = formats.filter(|format| *format != SplatFormat::SogFolder);
    files.map(|format| (format.suffix().trim_start_matches('.'), format))
}

/// The edited scene as a file of a format, or the list of edits.
async fn download(State(shared): App, Path(name): Path<String>) -> Response {
    let known = downloads().find(|(known, _)| *known == name);
    let is_list = name == "edits.toml";
    if shared.subject.editing.is_err() || (known.is_none() && !is_list) {
        return StatusCode::NOT_FOUND.into_response();
    }
    let Ok(_permit) = shared.packing.acquire().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    let worker = shared.clone();
    let written = tokio::task::spawn_blocking(move || -> Result<(String, Vec<u8>), String> {
        let editing = worker.subject.editing.as_ref().map_err(|why| (*why).to_owned())?;
        let stem: String = stem_of(&editing.source)
            .chars()
            .map(|c| {
                if c.is_ascii_alphanumeric() || "-_".contains(c) {
                    c
                } else {
                    '_'
                }
            })
            .collect();
        let Some((end, format)) = known else {
            return Ok((format!("{stem}.edits.toml"), editing.list().into_bytes()));
        };
        let cloud = editing.cloud().map_err(|error| error.to_string())?;
        let bytes = encode_splats(format, &cloud, &Default::default()).map_err(|error| error.to_string())?;
        Ok((format!("{stem}.{end}"), bytes))
    });
    match written.await {
        Ok(Ok((name, bytes))) => {
            let disposition = format!("attachment; filename=\"{name}\"");
            let headers = [
                (CONTENT_TYPE, "application/octet-stream"),
                (CONTENT_DISPOSITION, disposition.as_str()),
            ];
            (headers, Body::from(bytes)).into_response()
        }
        Ok(Err(why)) => (StatusCode::INTERNAL_SERVER_ERROR, why).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Keeps a scene that a page sends, to be merged by an edit; the response has the name by which the edit finds it.
async fn upload(State(shared): App, Path(name): Path<String>, body: Body) -> Response {
    if shared.subject.editing.is_err() {
        return StatusCode::NOT_FOUND.into_response();
    }
    let Ok(_permit) = shared.uploading.acquire().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    let bytes = match timeout(UPLOAD_TIMEOUT, to_bytes(body, MAX_UPLOAD_BYTES)).await {
        Ok(Ok(bytes)) => bytes,
        Ok(Err(_)) => {
            let why = "the scene is truncated, or larger than 1 GiB: merge it with irradia edit";
            return (StatusCode::PAYLOAD_TOO_LARGE, why).into_response();
        }
        Err(_) => return (StatusCode::REQUEST_TIMEOUT, "sending the scene took too long").into_response(),
    };
    let worker = shared.clone();
    let added = tokio::task::spawn_blocking(move || match &worker.subject.editing {
        Ok(editing) => editing
            .uploads
            .add(&name, bytes.into())
            .map_err(|error| error.to_string()),
        Err(why) => Err((*why).to_owned()),
    });
    match added.await {
        Ok(Ok((name, splats))) => json!({ "name": name, "splats": splats }).to_string().into_response(),
        Ok(Err(why)) => (StatusCode::UNPROCESSABLE_ENTITY, why).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// The photograph of a view as JPEG, with at most `side` pixels on its longer side.
async fn photo(State(shared): App, index: usize, side: Option<u32>) -> Response {
    let answer = |bytes: Bytes| {
        (
            [(CONTENT_TYPE, "image/jpeg"), (CACHE_CONTROL, "private, max-age=3600")],
            bytes,
        )
            .into_response()
    };
    let thumbnails = || shared.thumbnails.lock().unwrap_or_else(PoisonError::into_inner);
    if side.is_some()
        && let Some(bytes) = thumbnails().get(&index)
    {
        return answer(bytes.clone());
    }
    let view = shared.subject.views.0.get(index);
    let source = view.and_then(|view| Some((view.photo.clone()?, view.camera.intrinsics)));
    let background = shared
        .subject
        .edition()
        .map_or([0.0; 3], |edition| edition.scene().options.background);
    let (Some((source, k)), Ok(_permit)) = (source, shared.decoding.acquire().await) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    let encoded = tokio::task::spawn_blocking(move || {
        let photo = match side {
            Some(side) => {
                let k = k.scaled((side as f32 / k.width.max(k.height) as f32).min(1.0));
                source.load_at(k.width, k.height)?
            }
            None => source.load()?,
        };
        Ok::<_, irradia_scene::LoadError>(encode(
            &photo.over(background),
            photo.width,
            photo.height,
            PHOTO_QUALITY,
        ))
    });
    match encoded.await {
        Ok(Ok(jpeg)) => {
            let bytes = Bytes::from(jpeg);
            let mut kept = thumbnails();
            if side.is_some() && kept.values().map(Bytes::len).sum::<usize>() < MAX_THUMBNAIL_BYTES {
                kept.insert(index, bytes.clone());
            }
            answer(bytes)
        }
        Ok(Err(error)) => {
            shared.notices.report_once("photograph", &error);
            (StatusCode::NOT_FOUND, error.to_string()).into_response()
        }
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}
