//! Files of the web page, embedded from the directory of this crate.
//!
//! ```
//! let index = ros2probe_page::FILES.iter().find(|file| file.path == "index.html");
//! assert!(index.is_some_and(|file| file.media_type.starts_with("text/html")));
//! ```

#![forbid(unsafe_code)]

/// One file of the page.
#[derive(Clone, Copy, Debug)]
pub struct File {
    /// Path below `/page/`.
    pub path: &'static str,
    /// Value of `Content-Type`.
    pub media_type: &'static str,
    /// Content, uncompressed.
    pub bytes: &'static [u8],
}

impl File {
    const fn new(path: &'static str, media_type: &'static str, bytes: &'static [u8]) -> Self {
        Self {
            path,
            media_type,
            bytes,
        }
    }
}

/// Every file, by its path below `/page/`; `index.html` is also served at `/`.
pub static FILES: [File; 46] = [
    File::new("api.js", SCRIPT_TYPE, include_bytes!("../api.js")),
    File::new("app.css", CSS_TYPE, include_bytes!("../app.css")),
    File::new("app.js", SCRIPT_TYPE, include_bytes!("../app.js")),
    File::new("camera.js", SCRIPT_TYPE, include_bytes!("../camera.js")),
    File::new("chains.js", SCRIPT_TYPE, include_bytes!("../chains.js")),
    File::new("chart.js", SCRIPT_TYPE, include_bytes!("../chart.js")),
    File::new("dialogs.js", SCRIPT_TYPE, include_bytes!("../dialogs.js")),
    File::new("format.js", SCRIPT_TYPE, include_bytes!("../format.js")),
    File::new(
        "graph-model.js",
        SCRIPT_TYPE,
        include_bytes!("../graph-model.js"),
    ),
    File::new("icon.svg", SVG_TYPE, include_bytes!("../icon.svg")),
    File::new("index.html", HTML_TYPE, include_bytes!("../index.html")),
    File::new("inside.js", SCRIPT_TYPE, include_bytes!("../inside.js")),
    File::new("late.js", SCRIPT_TYPE, include_bytes!("../late.js")),
    File::new(
        "layout-worker.js",
        SCRIPT_TYPE,
        include_bytes!("../layout-worker.js"),
    ),
    File::new("layout.js", SCRIPT_TYPE, include_bytes!("../layout.js")),
    File::new("message.js", SCRIPT_TYPE, include_bytes!("../message.js")),
    File::new("past.js", SCRIPT_TYPE, include_bytes!("../past.js")),
    File::new("preview.js", SCRIPT_TYPE, include_bytes!("../preview.js")),
    File::new("qos.js", SCRIPT_TYPE, include_bytes!("../qos.js")),
    File::new("router.js", SCRIPT_TYPE, include_bytes!("../router.js")),
    File::new("state.js", SCRIPT_TYPE, include_bytes!("../state.js")),
    File::new("store.js", SCRIPT_TYPE, include_bytes!("../store.js")),
    File::new("stream.js", SCRIPT_TYPE, include_bytes!("../stream.js")),
    File::new("table.js", SCRIPT_TYPE, include_bytes!("../table.js")),
    File::new("timebar.js", SCRIPT_TYPE, include_bytes!("../timebar.js")),
    File::new(
        "transforms.js",
        SCRIPT_TYPE,
        include_bytes!("../transforms.js"),
    ),
    File::new("ui.js", SCRIPT_TYPE, include_bytes!("../ui.js")),
    File::new(
        "vendor/hooks.mjs",
        SCRIPT_TYPE,
        include_bytes!("../vendor/hooks.mjs"),
    ),
    File::new(
        "vendor/htm.mjs",
        SCRIPT_TYPE,
        include_bytes!("../vendor/htm.mjs"),
    ),
    File::new(
        "vendor/preact.mjs",
        SCRIPT_TYPE,
        include_bytes!("../vendor/preact.mjs"),
    ),
    File::new(
        "vendor/uPlot.iife.min.js",
        SCRIPT_TYPE,
        include_bytes!("../vendor/uPlot.iife.min.js"),
    ),
    File::new(
        "vendor/uPlot.min.css",
        CSS_TYPE,
        include_bytes!("../vendor/uPlot.min.css"),
    ),
    File::new(
        "views/agent.js",
        SCRIPT_TYPE,
        include_bytes!("../views/agent.js"),
    ),
    File::new(
        "views/chains.js",
        SCRIPT_TYPE,
        include_bytes!("../views/chains.js"),
    ),
    File::new(
        "views/doctor.js",
        SCRIPT_TYPE,
        include_bytes!("../views/doctor.js"),
    ),
    File::new(
        "views/events.js",
        SCRIPT_TYPE,
        include_bytes!("../views/events.js"),
    ),
    File::new(
        "views/fleet.js",
        SCRIPT_TYPE,
        include_bytes!("../views/fleet.js"),
    ),
    File::new(
        "views/graph.js",
        SCRIPT_TYPE,
        include_bytes!("../views/graph.js"),
    ),
    File::new(
        "views/inside.js",
        SCRIPT_TYPE,
        include_bytes!("../views/inside.js"),
    ),
    File::new(
        "views/late.js",
        SCRIPT_TYPE,
        include_bytes!("../views/late.js"),
    ),
    File::new(
        "views/nodes.js",
        SCRIPT_TYPE,
        include_bytes!("../views/nodes.js"),
    ),
    File::new(
        "views/overview.js",
        SCRIPT_TYPE,
        include_bytes!("../views/overview.js"),
    ),
    File::new(
        "views/recordings.js",
        SCRIPT_TYPE,
        include_bytes!("../views/recordings.js"),
    ),
    File::new(
        "views/robot.js",
        SCRIPT_TYPE,
        include_bytes!("../views/robot.js"),
    ),
    File::new(
        "views/topic.js",
        SCRIPT_TYPE,
        include_bytes!("../views/topic.js"),
    ),
    File::new(
        "views/topics.js",
        SCRIPT_TYPE,
        include_bytes!("../views/topics.js"),
    ),
];

const CSS_TYPE: &str = "text/css; charset=utf-8";
const HTML_TYPE: &str = "text/html; charset=utf-8";
const SCRIPT_TYPE: &str = "text/javascript; charset=utf-8";
const SVG_TYPE: &str = "image/svg+xml";
