//! What is answered: the page's files, photographs, splats, and the socket. No path of a request names a file.

use crate::compact::compact;
use crate::desk::Desk;
use crate::draw::encode;
use crate::guard::{Entry, Guard, TOKEN};
use crate::message::MAX_REQUEST;
use crate::notices::Notices;
use crate::subject::Subject;
use crate::{client, page};
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, Request, State, WebSocketUpgrade};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, SET_COOKIE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use irradia_scene::Photo;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::Semaphore;

/// Longer side of a thumbnail, pixels.
const THUMBNAIL: u32 = 192;
/// Bytes of thumbnails that are kept.
const THUMBNAILS: usize = 16 << 20;
/// JPEG quality of photographs.
const QUALITY: u8 = 90;
/// Only what this server serves is loaded, and nobody may frame the page.
const POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; \
                      base-uri 'none'; form-action 'none'";

/// What all requests share.
pub(crate) struct Shared {
    pub subject: Subject,
    pub desk: Desk,
    pub guard: Guard,
    pub notices: Arc<Notices>,
    /// The compact splats of a version.
    splats: Mutex<Option<(u64, Bytes)>>,
    thumbnails: Mutex<HashMap<usize, Bytes>>,
    /// Photographs that may be decoded at once.
    decoding: Semaphore,
    /// Scenes that may be packed at once.
    packing: Semaphore,
}

impl Shared {
    pub fn new(subject: Subject, guard: Guard, notices: Arc<Notices>) -> Self {
        Self {
            subject,
            desk: Desk::default(),
            guard,
            notices,
            splats: Mutex::default(),
            thumbnails: Mutex::default(),
            decoding: Semaphore::new(2),
            packing: Semaphore::new(1),
        }
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
        .route(
            "/view/{view}/photo",
            get(|app: App, Path(view): Path<usize>| photo(app, view, None)),
        )
        .route(
            "/view/{view}/thumbnail",
            get(|app: App, Path(view): Path<usize>| photo(app, view, Some(THUMBNAIL))),
        )
        .route("/socket", get(socket))
        .layer(from_fn_with_state(shared.clone(), guarded))
        .with_state(shared)
}

/// Refuses what the guard refuses; adds the headers that every answer has.
async fn guarded(State(shared): App, request: Request, next: Next) -> Response {
    let entry = shared.guard.check(request.method(), request.uri(), request.headers());
    let mut response = match entry {
        Ok(_) => next.run(request).await,
        Err(refusal) => {
            let reason = refusal.reason();
            shared.notices.once(reason, format_args!("refused a request: {reason}"));
            (StatusCode::FORBIDDEN, reason).into_response()
        }
    };
    let headers = response.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers
        .entry(CACHE_CONTROL)
        .or_insert(HeaderValue::from_static("no-store"));
    if entry == Ok(Entry::ByAddress)
        && let Some(token) = &shared.guard.token
        && let Ok(cookie) = HeaderValue::from_str(&format!("{TOKEN}={token}; HttpOnly; SameSite=Strict; Path=/"))
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
        if let Some((_, bytes)) = kept.as_ref().filter(|(version, _)| *version == edition.version) {
            return Some(bytes.clone());
        }
        let scene = edition.scene();
        let bytes = Bytes::from(compact(scene.model.splats()?, scene.options.sh_degree, usize::MAX));
        *kept = Some((edition.version, bytes.clone()));
        Some(bytes)
    });
    match packed.await {
        Ok(Some(bytes)) => ([(CONTENT_TYPE, "application/octet-stream")], Body::from(bytes)).into_response(),
        _ => StatusCode::NOT_FOUND.into_response(),
    }
}

/// The photograph of a view as JPEG, with at most `side` pixels on its longer side.
async fn photo(State(shared): App, view: usize, side: Option<u32>) -> Response {
    let answer = |bytes: Bytes| {
        (
            [(CONTENT_TYPE, "image/jpeg"), (CACHE_CONTROL, "private, max-age=3600")],
            bytes,
        )
            .into_response()
    };
    let thumbnails = || shared.thumbnails.lock().unwrap_or_else(PoisonError::into_inner);
    if side.is_some()
        && let Some(bytes) = thumbnails().get(&view)
    {
        return answer(bytes.clone());
    }
    let source = shared.subject.views.0.get(view).and_then(|view| view.photo.clone());
    let background = shared
        .subject
        .edition()
        .map_or([0.0; 3], |edition| edition.scene().options.background);
    let (Some(source), Ok(_permit)) = (source, shared.decoding.acquire().await) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    let encoded = tokio::task::spawn_blocking(move || {
        let photo = source.load()?;
        let photo = match side {
            Some(side) => fitted(&photo, side),
            None => photo,
        };
        Ok::<_, irradia_scene::LoadError>(encode(&photo.over(background), photo.width, photo.height, QUALITY))
    });
    match encoded.await {
        Ok(Ok(jpeg)) => {
            let bytes = Bytes::from(jpeg);
            let mut kept = thumbnails();
            if side.is_some() && kept.values().map(Bytes::len).sum::<usize>() < THUMBNAILS {
                kept.insert(view, bytes.clone());
            }
            answer(bytes)
        }
        Ok(Err(error)) => {
            shared.notices.once("photograph", &error);
            (StatusCode::NOT_FOUND, error.to_string()).into_response()
        }
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// `photo` with at most `side` pixels on its longer side.
fn fitted(photo: &Photo, side: u32) -> Photo {
    let factor = (side as f32 / photo.width.max(photo.height) as f32).min(1.0);
    let scaled = |side: u32| ((side as f32 * factor).round() as u32).max(1);
    photo.resized(scaled(photo.width), scaled(photo.height))
}
