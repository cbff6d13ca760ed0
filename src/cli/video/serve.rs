//! `ddx video serve`: the streams of the domain in a browser.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Query, Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Json, Response};
use axum::routing::get;
use ddx_store::{Delivery, Store};
use ddx_video::convert::to_rgb;
use ddx_video::picture::{PictureFormat, encode};
use ddx_wire::{Pattern, WriterState};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::render::bytes;
use super::{SLICE, field};
use crate::error::{Exit, Failure, Outcome};
use crate::video::{self, StreamReader, frame};

/// Where to serve.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Address to listen on; any but loopback shows the streams to whoever reaches it
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
}

/// What every request needs.
#[derive(Debug)]
struct Shared {
    store: Store,
    interrupt: Interrupt,
    /// Movies that are being shown.
    movies: AtomicUsize,
    listen: SocketAddr,
}

/// Which stream, and which of its fields.
#[derive(Debug, Deserialize)]
struct Wanted {
    name: String,
    field: Option<String>,
    /// Most frames a second, asked of other hosts too.
    rate: Option<f64>,
}

/// A request that cannot be answered.
#[derive(Debug)]
struct Refusal(StatusCode, String);

/// One of the movies that are being shown.
#[derive(Debug)]
struct Movie(Arc<Shared>);

/// Runs the verb. It ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let interrupt = Interrupt::listen(context.tethered)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let listener = runtime
        .block_on(tokio::net::TcpListener::bind(args.listen))
        .with_context(|| format!("listen on {}", args.listen))?;
    let listen = listener.local_addr()?;
    let shared = Arc::new(Shared {
        store: context.store("video serve")?,
        interrupt: interrupt.clone(),
        movies: AtomicUsize::new(0),
        listen,
    });
    let url = format!("http://{listen}/");
    context.out.either(
        &json!({ "url": url }),
        &format!("streams are shown at {url}"),
    )?;
    runtime.block_on(async {
        axum::serve(listener, router(shared))
            .with_graceful_shutdown(interrupt.raised())
            .await
    })?;
    Ok(Exit::Done)
}

fn router(shared: Arc<Shared>) -> Router {
    Router::new()
        .route("/", get(async || Html(PAGE)))
        .route("/streams", get(streams))
        .route("/movie", get(movie))
        .route("/snap.ppm", get(snap))
        .route("/snap.png", get(snap))
        .route("/snap.jpg", get(snap))
        .route("/snap.tiff", get(snap))
        .layer(middleware::from_fn_with_state(Arc::clone(&shared), own))
        .with_state(shared)
}

/// A page of somebody else must not read from a server on loopback by giving its own name this address.
async fn own(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let named = request.headers().get(header::HOST);
    let named = named
        .and_then(|host| host.to_str().ok())
        .unwrap_or_default();
    let name = named.rsplit_once(':').map_or(named, |(name, _)| name);
    if shared.listen.ip().is_loopback() && !["localhost", "127.0.0.1", "[::1]"].contains(&name) {
        return Refusal(StatusCode::FORBIDDEN, format!("this is not {named}")).into_response();
    }
    next.run(request).await
}

/// The streams that are written now, of all hosts.
async fn streams(State(shared): State<Arc<Shared>>) -> Result<Json<Value>, Refusal> {
    let all = blocking(move || {
        let hash = video::schema()?.hash();
        let mut all = Vec::new();
        for entry in shared.store.list(&Pattern::everything())? {
            if entry.schema_hash == hash {
                all.push(json!({
                    "name": entry.name.as_str(),
                    "host": entry.host.as_str(),
                    "program": entry.program,
                    "frame": bytes(u64::from(entry.capacity_bytes)),
                    "written": entry.writer == Some(WriterState::Live),
                }));
            }
        }
        Ok(all)
    });
    Ok(Json(all.await?.into()))
}

async fn snap(
    State(shared): State<Arc<Shared>>,
    Query(wanted): Query<Wanted>,
    request: Request,
) -> Result<Response, Refusal> {
    let (_, extension) = request.uri().path().rsplit_once('.').unwrap_or_default();
    let (format, kind) = match extension {
        "png" => (PictureFormat::Png, "image/png"),
        "jpg" => (PictureFormat::Jpeg { quality: 90 }, "image/jpeg"),
        "tiff" => (PictureFormat::Tiff, "image/tiff"),
        _ => (PictureFormat::Ppm, "image/x-portable-pixmap"),
    };
    let file = blocking(move || {
        let mut stream = StreamReader::open(&shared.store, &wanted.name, Delivery::Latest, None)?;
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline && !shared.interrupt.is_raised() {
            if let Some(guard) = stream.frames().next_pinned(SLICE)? {
                let frame = frame(&guard)?;
                let field = field(&frame, wanted.field.as_deref())?;
                return Ok(encode(&to_rgb(&field)?, format)?);
            }
        }
        Err(Failure::new(format!("no frame of `{}` came", wanted.name)))
    });
    Ok(([(header::CONTENT_TYPE, kind)], file.await?).into_response())
}

/// JPEG after JPEG, each in place of the one before, as browsers show them since Netscape.
async fn movie(
    State(shared): State<Arc<Shared>>,
    Query(wanted): Query<Wanted>,
) -> Result<Response, Refusal> {
    if wanted
        .rate
        .is_some_and(|rate| !(0.001..=1e6).contains(&rate))
    {
        return Err(Refusal(StatusCode::BAD_REQUEST, "no such rate".to_owned()));
    }
    let movie = Movie(Arc::clone(&shared));
    if shared.movies.fetch_add(1, Ordering::Relaxed) >= MOVIES_MAX {
        let text = format!("{MOVIES_MAX} movies are being shown already");
        return Err(Refusal(StatusCode::SERVICE_UNAVAILABLE, text));
    }
    let stream = blocking(move || {
        let stream =
            StreamReader::open(&shared.store, &wanted.name, Delivery::Latest, wanted.rate)?;
        Ok((stream, wanted.field))
    });
    let (stream, field) = stream.await?;
    // A browser that is slow gets the newest when it is ready for it.
    let (parts, body) = mpsc::channel(1);
    thread::Builder::new()
        .name("ddx-movie".to_owned())
        .spawn(move || show(&movie, stream, field.as_deref(), &parts))
        .map_err(|fault| Refusal(StatusCode::INTERNAL_SERVER_ERROR, fault.to_string()))?;
    let kind = format!("multipart/x-mixed-replace; boundary={BOUNDARY}");
    let body = Body::from_stream(ReceiverStream::new(body));
    Ok(([(header::CONTENT_TYPE, kind)], body).into_response())
}

fn show(
    movie: &Movie,
    mut stream: StreamReader,
    wanted: Option<&str>,
    parts: &mpsc::Sender<Result<Bytes, std::io::Error>>,
) {
    while !parts.is_closed() && !movie.0.interrupt.is_raised() {
        let part = match stream.frames().next_pinned(SLICE) {
            Ok(None) => continue,
            Ok(Some(guard)) => frame(&guard).map_err(Failure::from).and_then(|frame| {
                let field = field(&frame, wanted)?;
                let file = encode(&to_rgb(&field)?, PictureFormat::Jpeg { quality: QUALITY })?;
                Ok(part(&file))
            }),
            Err(error) => Err(error.into()),
        };
        let ends = part.is_err();
        if parts
            .blocking_send(
                part.map_err(|failure: Failure| std::io::Error::other(failure.to_string())),
            )
            .is_err()
            || ends
        {
            return;
        }
    }
}

fn part(file: &[u8]) -> Bytes {
    let mut part = format!(
        "--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n",
        file.len()
    )
    .into_bytes();
    part.extend_from_slice(file);
    part.extend_from_slice(b"\r\n");
    part.into()
}

/// Runs what waits for the daemon or computes, where it keeps no other request waiting.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> Result<T, Refusal> {
    match tokio::task::spawn_blocking(work).await {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(failure)) => Err(Refusal(StatusCode::NOT_FOUND, failure.to_string())),
        Err(fault) => Err(Refusal(
            StatusCode::INTERNAL_SERVER_ERROR,
            fault.to_string(),
        )),
    }
}

impl Drop for Movie {
    fn drop(&mut self) {
        self.0.movies.fetch_sub(1, Ordering::Relaxed);
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        (self.0, format!("{}\n", self.1)).into_response()
    }
}

const PAGE: &str = include_str!("serve/page.html");
const BOUNDARY: &str = "ddx-frame";
/// Of JPEG: what a moving picture does not show better.
const QUALITY: u8 = 80;
const MOVIES_MAX: usize = 32;
/// How long a frame may take to come when somebody asks for one.
const PATIENCE: Duration = Duration::from_secs(5);
