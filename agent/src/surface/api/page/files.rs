//! The files of the page, as the folder `agent/page/` has them; a test compares.

use super::File;

/// Each file, by its path below `/page/`; `index.html` is served at `/`, too.
pub(super) static FILES: [File; 34] = [
    File::new("api.js", SCRIPT, include_bytes!("../../../../page/api.js")),
    File::new("app.css", CSS, include_bytes!("../../../../page/app.css")),
    File::new("app.js", SCRIPT, include_bytes!("../../../../page/app.js")),
    File::new(
        "camera.js",
        SCRIPT,
        include_bytes!("../../../../page/camera.js"),
    ),
    File::new(
        "chart.js",
        SCRIPT,
        include_bytes!("../../../../page/chart.js"),
    ),
    File::new(
        "dialogs.js",
        SCRIPT,
        include_bytes!("../../../../page/dialogs.js"),
    ),
    File::new(
        "format.js",
        SCRIPT,
        include_bytes!("../../../../page/format.js"),
    ),
    File::new(
        "graph-model.js",
        SCRIPT,
        include_bytes!("../../../../page/graph-model.js"),
    ),
    File::new("icon.svg", SVG, include_bytes!("../../../../page/icon.svg")),
    File::new(
        "index.html",
        HTML,
        include_bytes!("../../../../page/index.html"),
    ),
    File::new(
        "layout-worker.js",
        SCRIPT,
        include_bytes!("../../../../page/layout-worker.js"),
    ),
    File::new(
        "layout.js",
        SCRIPT,
        include_bytes!("../../../../page/layout.js"),
    ),
    File::new(
        "message.js",
        SCRIPT,
        include_bytes!("../../../../page/message.js"),
    ),
    File::new("qos.js", SCRIPT, include_bytes!("../../../../page/qos.js")),
    File::new(
        "router.js",
        SCRIPT,
        include_bytes!("../../../../page/router.js"),
    ),
    File::new(
        "state.js",
        SCRIPT,
        include_bytes!("../../../../page/state.js"),
    ),
    File::new(
        "store.js",
        SCRIPT,
        include_bytes!("../../../../page/store.js"),
    ),
    File::new(
        "stream.js",
        SCRIPT,
        include_bytes!("../../../../page/stream.js"),
    ),
    File::new(
        "table.js",
        SCRIPT,
        include_bytes!("../../../../page/table.js"),
    ),
    File::new(
        "timebar.js",
        SCRIPT,
        include_bytes!("../../../../page/timebar.js"),
    ),
    File::new("ui.js", SCRIPT, include_bytes!("../../../../page/ui.js")),
    File::new(
        "vendor/hooks.mjs",
        SCRIPT,
        include_bytes!("../../../../page/vendor/hooks.mjs"),
    ),
    File::new(
        "vendor/htm.mjs",
        SCRIPT,
        include_bytes!("../../../../page/vendor/htm.mjs"),
    ),
    File::new(
        "vendor/preact.mjs",
        SCRIPT,
        include_bytes!("../../../../page/vendor/preact.mjs"),
    ),
    File::new(
        "vendor/uPlot.iife.min.js",
        SCRIPT,
        include_bytes!("../../../../page/vendor/uPlot.iife.min.js"),
    ),
    File::new(
        "vendor/uPlot.min.css",
        CSS,
        include_bytes!("../../../../page/vendor/uPlot.min.css"),
    ),
    File::new(
        "views/agent.js",
        SCRIPT,
        include_bytes!("../../../../page/views/agent.js"),
    ),
    File::new(
        "views/events.js",
        SCRIPT,
        include_bytes!("../../../../page/views/events.js"),
    ),
    File::new(
        "views/graph.js",
        SCRIPT,
        include_bytes!("../../../../page/views/graph.js"),
    ),
    File::new(
        "views/nodes.js",
        SCRIPT,
        include_bytes!("../../../../page/views/nodes.js"),
    ),
    File::new(
        "views/overview.js",
        SCRIPT,
        include_bytes!("../../../../page/views/overview.js"),
    ),
    File::new(
        "views/recordings.js",
        SCRIPT,
        include_bytes!("../../../../page/views/recordings.js"),
    ),
    File::new(
        "views/topic.js",
        SCRIPT,
        include_bytes!("../../../../page/views/topic.js"),
    ),
    File::new(
        "views/topics.js",
        SCRIPT,
        include_bytes!("../../../../page/views/topics.js"),
    ),
];

const CSS: &str = "text/css; charset=utf-8";
const HTML: &str = "text/html; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";
