//! `rapid inspect --plot`: the picture of an episode that the program recorded, as XML.

use std::path::Path;

use roxmltree::{Document, Node};

use crate::support::Place;

/// An element's name, with that of its language.
const fn svg_name(name: &str) -> (&str, &str) {
    ("http://www.w3.org/2000/svg", name)
}

/// Texts of a class, in their order.
fn texts<'a>(document: &'a Document<'_>, class: &str) -> Vec<&'a str> {
    let of_class = |node: &Node<'_, '_>| node.has_tag_name(svg_name("text")) && node.attribute("class") == Some(class);
    document.descendants().filter(of_class).filter_map(|node| node.text()).collect()
}

/// The pictures in it: each is a whole JPEG file.
fn pictures(document: &Document<'_>) -> usize {
    let images = document.descendants().filter(|node| node.has_tag_name(svg_name("image")));
    let jpegs = images.map(|image| image.attribute("href").expect("a picture"));
    // The first bytes of a JPEG file, as base64.
    jpegs.inspect(|jpeg| assert!(jpeg.starts_with("data:image/jpeg;base64,/9j/"), "{jpeg}")).count()
}

fn style<'a>(document: &'a Document<'_>) -> &'a str {
    let style = document.descendants().find(|node| node.has_tag_name(svg_name("style")));
    style.and_then(|style| style.text()).expect("a style")
}

/// The episodes in `folder`, and the pictures.
fn files(place: &Place, folder: &str, ending: &str) -> Vec<String> {
    place.files(folder).into_iter().filter(|name| name.ends_with(ending)).collect()
}

#[test]
fn an_episode_is_drawn_with_presence_pictures_marks_and_notes() {
    let place = Place::new();
    let record =
        ["--sim", "--headless", "--record", "--duration", "8s", "--out", "out", "--task", "put </title> & \"x\""];
    let running = place.start(&record, "recording");
    assert_eq!(place.run(&["episode", "mark", "a <b> & c"]).status.code(), Some(0));
    assert_eq!(place.run(&["episode", "label", "failure", "it <slipped>"]).status.code(), Some(0));
    running.end();
    let [episode] = files(&place, "out", ".mcap").try_into().expect("one episode");
    let output = place.run(&["inspect", "out", "--plot"]);
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    let name = episode.replace(".mcap", ".svg");
    assert_eq!(String::from_utf8(output.stdout).expect("text"), format!("out/{name}\n"));
    let svg = std::fs::read_to_string(place.path("out").join(&name)).expect("the picture");
    let document = Document::parse(&svg).expect("XML");
    assert_eq!(texts(&document, "title"), [episode.as_str()]);
    assert_eq!(texts(&document, "name"), ["mask", "cam_wrist", "tactile_tip", "motor_state"]);
    // The demonstration unplugs the tactile camera after 4 s and plugs it in again.
    assert_eq!(texts(&document, "code")[..2], ["0x07", "0x05"]);
    assert_eq!(texts(&document, "caption"), ["a <b> & c"]);
    let about = texts(&document, "");
    assert!(about.iter().any(|text| text.contains("put </title> & \"x\"")), "{about:?}");
    assert!(about.iter().any(|text| text.contains("label failure: it <slipped>")), "{about:?}");
    assert!((9..=16).contains(&pictures(&document)), "{}", pictures(&document));
    assert!(svg.len() < 300_000, "{}", svg.len());

    // The one in the documentation is of this program.
    let documented = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/episode.svg");
    let documented = std::fs::read_to_string(documented).expect("docs/episode.svg");
    let of_page = Document::parse(&documented).expect("XML");
    let fixed = |document: &Document<'_>| (style(document).to_owned(), texts(document, "name").join(" "));
    assert_eq!(fixed(&of_page), fixed(&document), "make docs/episode.svg again: docs/episodes.md has the commands");
    assert!((9..=16).contains(&pictures(&of_page)));

    // An earlier picture is replaced, another file is not.
    assert!(place.run(&["inspect", &format!("out/{episode}"), "--plot"]).status.success());
    place.write("drawing.svg", "<svg/>");
    let refused = place.run(&["inspect", &format!("out/{episode}"), "--plot=drawing.svg"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert!(String::from_utf8_lossy(&refused.stderr).contains("drawing.svg: not a picture of `rapid inspect --plot`"));
    assert_eq!(std::fs::read_to_string(place.path("drawing.svg")).expect("the drawing"), "<svg/>");
    let stdout = place.run(&["inspect", &format!("out/{episode}"), "--plot=-"]).stdout;
    assert_eq!(String::from_utf8(stdout).expect("text"), svg);
    damaged(&place, &episode);
}

/// Pictures of what is left of the episode after damage, and of what is not an episode.
fn damaged(place: &Place, episode: &str) {
    let whole = std::fs::read(place.path("out").join(episode)).expect("the episode");
    std::fs::create_dir(place.path("bad")).expect("a folder");
    let mut holed = whole.clone();
    let third = holed.len() / 3;
    holed[third..2 * third].fill(0);
    place.write("bad/none.mcap", "no episode");
    std::fs::write(place.path("bad/a<b>&\"'.mcap"), &holed).expect("a file");
    std::fs::write(place.path("bad/cut.mcap.partial"), &whole[..third]).expect("a file");
    let output = place.run(&["inspect", "bad", "--plot"]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("none.mcap: not an MCAP file"), "{output:?}");
    assert_eq!(files(place, "bad", ".svg"), ["a<b>&\"'.svg", "cut.mcap.partial.svg"]);
    for (name, is_holed) in [("a<b>&\"'.svg", true), ("cut.mcap.partial.svg", false)] {
        let svg = std::fs::read_to_string(place.path("bad").join(name)).expect("the picture");
        let document = Document::parse(&svg).expect("XML");
        assert_eq!(texts(&document, "title"), [name.replace(".svg", if is_holed { ".mcap" } else { "" })]);
        assert_eq!(texts(&document, "name"), ["mask", "cam_wrist", "tactile_tip", "motor_state"]);
        let is_void = document
            .descendants()
            .any(|node| node.has_tag_name(svg_name("rect")) && node.attribute("class") == Some("void"));
        assert_eq!(is_void, is_holed, "{name}");
    }
}

#[test]
fn a_name_for_several_pictures_and_a_name_without_its_sign_are_refused_with_the_fix() {
    let place = Place::new();
    let refused = |arguments: &[&str], why: &str| {
        let output = place.run(arguments);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && text.contains(why), "{arguments:?}: {text}");
    };
    refused(&["inspect", "a.mcap", "b.mcap", "--plot=c.svg"], "2 episodes, and one place for a picture, c.svg");
    refused(&["inspect", "a.mcap", "b.mcap", "--plot=-"], "2 episodes");
    refused(&["inspect", "a.mcap", "--plot", "c.svg"], "--plot=c.svg");
    refused(&["inspect", "none.mcap", "--plot"], "none.mcap: ");
    refused(&["inspect", "none.mcap", "--plot=-", "--json"], "leave one of them out");
    assert!(files(&place, ".", ".svg").is_empty());
}
