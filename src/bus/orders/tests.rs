//! Orders and what becomes of them, by clients that wait and clients that are gone.

use iceoryx2::port::client::Client;

use super::*;
use Order::{Arm, Disarm};

const PATIENCE: Duration = Duration::from_secs(30);

/// `give` with a limit that no test waits for.
fn give_patiently(home: Home, damaged: Option<BusError>) -> Result<bool, BusError> {
    let (tell, told) = std::sync::mpsc::channel();
    let damaged = std::sync::Mutex::new(damaged);
    std::thread::spawn(move || {
        let damaged = || damaged.lock().expect("one thread").take();
        let _ = tell.send(give_through(home.node(), Disarm, 100 * PATIENCE, &damaged));
    });
    told.recv_timeout(PATIENCE).expect("an answer without the wait for one")
}

#[test]
fn nobody_is_waited_for_where_nobody_receives_and_damage_is_said_before_the_wait_is_over() {
    let home = |test: &str| Home::open(Some(&format!("orders{test}{}", std::process::id())), 0).expect("node");
    assert!(matches!(give_patiently(home("f"), None), Ok(false)));
    let damage = || BusError::Damaged { path: "/dev/shm/iox2_a.dynamic".into(), what: "it is damaged".to_owned() };
    let said = |given: Result<bool, BusError>| given.expect_err("it is damaged").to_string();
    assert!(said(give_patiently(home("g"), Some(damage()))).contains("iox2_a.dynamic"));
    // One that receives, and does not answer.
    let (instance, _home, _orders) = open("h");
    let client = Home::open(Some(&instance), 0).expect("node");
    assert!(said(give_patiently(client, Some(damage()))).contains("iox2_a.dynamic"));
}

fn open(test: &str) -> (String, Home, Orders) {
    let instance = format!("orders{test}{}", std::process::id());
    let home = Home::open(Some(&instance), 0).expect("node");
    let orders = Orders::open(home.node()).expect("orders");
    (instance, home, orders)
}

fn client(node: &Node<Service>) -> Client<Service, u8, (), u8, ()> {
    service(node).expect("service").client_builder().create().expect("client")
}

fn taken(orders: &Orders) -> Vec<Order> {
    let mut taken = Vec::new();
    orders
        .hand_over(&mut |order| {
            taken.push(order);
            Ok::<(), ()>(())
        })
        .expect("they are taken");
    taken
}

#[test]
fn an_order_that_is_taken_is_answered() {
    let (instance, _home, orders) = open("a");
    for order in [Arm, Disarm] {
        let given = std::thread::spawn({
            let instance = instance.clone();
            move || give(Some(&instance), order).expect("the bus")
        });
        let (begun, mut all) = (Instant::now(), Vec::new());
        while all.is_empty() {
            all.extend(taken(&orders));
            assert!(begun.elapsed() < PATIENCE, "{order:?} does not arrive");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(all, [order]);
        assert!(given.join().expect("no panic"), "{order:?} was taken, and its client is told so");
    }
}

#[test]
fn an_arm_whose_client_is_gone_is_not_carried_out_and_a_disarm_is() {
    let (_, home, orders) = open("b");
    let client = client(home.node());
    for (request, wanted) in [(1, &[][..]), (0, &[Disarm]), (7, &[])] {
        drop(client.send_copy(request).expect("it is sent"));
        assert_eq!(taken(&orders), wanted, "{request}");
    }
    // The whole program is gone.
    let other = self::client(home.node());
    drop(other.send_copy(1).expect("it is sent"));
    drop(other);
    assert_eq!(taken(&orders), []);
    // One that waits is heard after them.
    let waiting = client.send_copy(1).expect("it is sent");
    assert_eq!(taken(&orders), [Arm]);
    assert_eq!(waiting.receive().expect("the bus").map(|answer| *answer), Some(1));
}

#[test]
fn orders_of_before_the_device_was_there_are_not_for_it() {
    let (_, home, orders) = open("c");
    assert!(!orders.discard());
    let client = client(home.node());
    for (request, is_order) in [(0, true), (1, true), (9, false)] {
        let waiting = client.send_copy(request).expect("it is sent");
        assert_eq!(orders.discard(), is_order, "{request}");
        assert_eq!(taken(&orders), []);
        assert!(waiting.receive().expect("the bus").is_none(), "{request} counts as given");
    }
    drop(client.send_copy(1).expect("it is sent"));
    assert!(orders.discard(), "an order is one when its client is gone, too");
}

#[test]
fn an_order_that_the_actuator_does_not_take_is_not_answered() {
    let (_, home, orders) = open("d");
    let client = client(home.node());
    let first = client.send_copy(1).expect("it is sent");
    let second = client.send_copy(0).expect("it is sent");
    assert_eq!(orders.hand_over(&mut |_| Err("no")), Err("no"));
    assert_eq!(taken(&orders), [Disarm]);
    assert!(first.receive().expect("the bus").is_none());
    assert!(second.receive().expect("the bus").is_some());
}

#[test]
fn a_second_receiver_of_orders_is_named_as_the_cause() {
    let (_, home, _orders) = open("e");
    let Err(error) = Orders::open(home.node()) else { panic!("there is one place") };
    let error = error.to_string();
    assert!(error.contains("another program receives these orders already") && error.contains("--instance"), "{error}");
    assert!(!error.contains("another version"), "{error}");
}
