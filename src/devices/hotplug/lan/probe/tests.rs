use std::net::IpAddr;

use rapid_registry::device::DeviceNode;
use tokio::net::TcpListener;
use tokio::sync::mpsc;

use super::super::super::HotplugEvent;
use super::*;

const LOCAL: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

/// A server that handles each connection in this way; returns its address.
async fn server<F: Future<Output = ()> + Send>(answer: impl Fn(TcpStream) -> F + Send + 'static) -> SocketAddr {
    let listener = TcpListener::bind((LOCAL, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            answer(stream).await;
        }
    });
    address
}

fn closed_port() -> SocketAddr {
    let listener = std::net::TcpListener::bind((LOCAL, 0)).expect("a port");
    listener.local_addr().expect("an address")
}

#[tokio::test]
async fn a_reply_is_distinguished_from_silence() {
    let greeting = |text: &'static [u8]| {
        server(move |mut stream| async move {
            let _ = stream.read(&mut [0; 1024]).await;
            let _ = stream.write_all(text).await;
        })
    };
    let web = greeting(b"HTTP/1.0 404 Not Found\r\n\r\n").await;
    let ssh = greeting(b"SSH-2.0-OpenSSH\r\n").await;
    let silent = server(|stream| async move {
        tokio::spawn(async move {
            sleep(Duration::from_mins(1)).await;
            drop(stream);
        });
    })
    .await;
    for (probe, address, expected) in [
        (Probe::Tcp, web, Answer::Here),
        (Probe::Tcp, ssh, Answer::Here),
        (Probe::Tcp, silent, Answer::Here),
        (Probe::Tcp, closed_port(), Answer::Refused),
        (Probe::Http, web, Answer::Here),
        (Probe::Http, ssh, Answer::Silence),
        (Probe::Http, silent, Answer::Silence),
        (Probe::Http, closed_port(), Answer::Refused),
        (Probe::Udp, closed_port(), Answer::Silence),
    ] {
        assert_eq!(ask(Arc::new(probe.into()), address).await, expected, "{probe:?} {address}");
    }
}

#[tokio::test]
async fn a_device_of_another_computer_is_asked_for_by_its_name() {
    let reply = |head: Head| {
        server(move |mut stream| async move {
            let mut line = [0; 40];
            let count = stream.read(&mut line).await.unwrap_or(0);
            if line[..count] == *b"rapid-remote-1 robot-b cam\n" {
                let _ = stream.write_all(&head.bytes()).await;
            }
        })
    };
    let question = || Arc::new(Question::Remote("rapid-remote-1 robot-b cam\n".to_owned()));
    let present = reply(Head::default()).await;
    let absent = reply(Head { kind: Kind::Refused, length: 3, ..Head::default() }).await;
    let other = server(|mut stream| async move {
        let _ = stream.write_all(&[b'x'; HEAD]).await;
    })
    .await;
    let cases = [
        (present, Answer::Here),
        (absent, Answer::Refused),
        (other, Answer::Silence),
        (closed_port(), Answer::Refused),
    ];
    for (address, expected) in cases {
        assert_eq!(ask(question(), address).await, expected, "{address}");
    }
}

#[tokio::test]
async fn packets_of_the_device_are_received_and_the_port_is_released() {
    let port = closed_port();
    let sender = UdpSocket::bind((LOCAL, 0)).await.expect("a port");
    let mut received = Box::pin(ask(Arc::new(Question::Udp), port));
    let answer = loop {
        tokio::select! {
            answer = &mut received => break answer,
            () = sleep(Duration::from_millis(5)) => { let _ = sender.send_to(b"x", port).await; }
        }
    };
    assert_eq!(answer, Answer::Here);
    drop(received);
    UdpSocket::bind(port).await.expect("the port is free for the driver");
    // Such packets are not evidence of another device.
    let elsewhere = SocketAddr::from(([127, 0, 0, 9], closed_port().port()));
    let mut received = Box::pin(ask(Arc::new(Question::Udp), elsewhere));
    let answer = loop {
        tokio::select! {
            answer = &mut received => break answer,
            () = sleep(Duration::from_millis(5)) => {
                let _ = sender.send_to(b"x", (LOCAL, elsewhere.port())).await;
            }
        }
    };
    assert_eq!(answer, Answer::Silence);
}

#[tokio::test]
async fn a_device_on_this_machine_is_not_listened_for_on_the_network() {
    let asked = closed_port();
    let mut received = Box::pin(ask(Arc::new(Question::Udp), asked));
    let is_held = || std::net::UdpSocket::bind(asked).is_err();
    while !is_held() {
        tokio::select! {
            answer = &mut received => panic!("{answer:?} although nothing is sent"),
            () = sleep(Duration::from_millis(1)) => {}
        }
    }
    let elsewhere = std::net::UdpSocket::bind((std::net::Ipv4Addr::new(127, 0, 0, 2), asked.port()));
    assert!(elsewhere.is_ok(), "more than {asked} is bound: {elsewhere:?}");
    drop(received);
}

#[tokio::test]
async fn a_refused_probe_proves_nothing_while_the_driver_holds_the_connection() {
    let listener = TcpListener::bind((LOCAL, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let (notify, mut reported) = mpsc::channel(8);
    let lease = EVERY * 4;
    tokio::spawn(watch(Watch::new("cam", lease, notify), address, address, Question::Tcp));
    let Some(HotplugEvent::Added(attachment)) = reported.recv().await else { panic!("not found") };
    let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
    // It has a connection, and sends less often than it would be queried.
    drop(listener);
    last_received.now();
    let since = last_received.at();
    let Some(HotplugEvent::Removed { noticed, .. }) = reported.recv().await else { panic!("not gone") };
    assert!(noticed.since(since) >= lease, "gone after {:?}", noticed.since(since));
}

#[tokio::test]
async fn a_lease_waits_for_a_driver_that_is_started_later() {
    let (notify, mut reported) = mpsc::channel(8);
    let mut watch = Watch::new("lidar", EVERY, notify).waits(EVERY * 2);
    let begin = Stamp::now();
    watch.found(closed_port(), None, begin).await;
    let Some(HotplugEvent::Added(attachment)) = reported.recv().await else { panic!("not found") };
    let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
    watch.check(begin.after(EVERY * 2)).await;
    assert!(watch.is_there(), "its driver has not begun");
    // From the first packet on, the lease has its normal length.
    last_received.now();
    watch.check(begin).await;
    watch.check(last_received.at().after(EVERY)).await;
    assert!(!watch.is_there());
    // A device that never sent is gone in the end.
    watch.found(closed_port(), None, begin.after(EVERY * 20)).await;
    watch.check(begin.after(EVERY * 23)).await;
    assert!(!watch.is_there());
}

#[tokio::test]
async fn a_device_appears_and_disappears_and_a_sending_one_is_not_probed() {
    let listener = TcpListener::bind((LOCAL, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let (notify, mut reported) = mpsc::channel(8);
    tokio::spawn(watch(Watch::new("cam", EVERY * 3, notify), address, address, Question::Tcp));
    let Some(HotplugEvent::Added(attachment)) = reported.recv().await else { panic!("not found") };
    let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
    drop(listener.accept().await);
    // While its driver receives from it, no probe connects.
    for _ in 0..30 {
        last_received.now();
        let asked = timeout(Duration::from_millis(100), listener.accept()).await;
        assert!(asked.is_err(), "asked although it sends");
    }
    drop(listener);
    let Some(HotplugEvent::Removed { source, .. }) = reported.recv().await else { panic!("not gone") };
    assert_eq!(source, UnplugSource::Lease);
    let _listener = TcpListener::bind(address).await.expect("the port again");
    assert!(matches!(reported.recv().await, Some(HotplugEvent::Added(_))), "found again");
}
