//! Declarations of the tables of commands: what agents, participants and routers can fill, and how
//! far.

use ros2probe_daemon::tables::DescribedWriters;

ros2probe_model::tables! {
    /// Topics that one stream of messages has described, in `rp`
    StreamTopics { name: "samples.topics", entries: 65_536, effect: "each message repeats its description" }
    /// Their writers
    StreamWriters { name: "samples.writers", entries: DescribedWriters::CAP, effect: "each message repeats its description" }
    /// Edges whose transforms `rp tf` keeps
    FrameEdges { name: "tf.edges", entries: 4096, effect: "its last transform is used" }
    /// Transforms of an edge in the last ten seconds
    FramePoses { name: "tf.poses", entries: 16_384, effect: "the oldest one is dropped" }
    /// Announcements of one kind that `rp discover` receives from a participant
    ReceivedAnnouncements { name: "discover.received", entries: 4096 }
    /// Endpoints of this participant
    DiscoveredEndpoints { name: "discover.endpoints", entries: 2 * ReceivedAnnouncements::CAP }
    /// Announcements of this participant with missing fragments
    PartialAnnouncements { name: "discover.partial", entries: 8 }
    /// Writers of user data of this participant
    UserWriters { name: "discover.writers", entries: 256 }
    /// Liveliness tokens of a router (`rp discover --router`)
    RouterTokens {
        name: "discover.tokens", entries: 65_536, effect: "a part is printed, and exit code 1", reported: "error",
    }
}
