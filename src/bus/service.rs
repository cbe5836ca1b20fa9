//! The iceoryx2 service used by the bus: iceoryx2's `ipc_threadsafe`, with [`Shared`] in place of its shared handles.
//!
//! iceoryx2 0.10 creates one handle for every loan and frees it when the sample is sent. Its own handles are an `Arc`
//! around a POSIX mutex: an allocation, a mutex set up and torn down for every sample. Ours reuses the memory and
//! avoids all of this.
//!
//! The nodes of a process are counted in the process's own memory: iceoryx2's own segment for this is writable by
//! everybody, outlives every run, and when damaged blocks every start for ever. Node numbers differ by process and
//! time.
//!
//! Invariant: everything another process sees (names, files, layouts) is iceoryx2's own: programs with the ordinary
//! `ipc` service communicate with this one.

use std::fmt::Debug;

use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::unique_id_generator::unique_system_id::UniqueSystemId;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_cal::shm_allocator::bump_allocator::BumpAllocator;
use iceoryx2_cal::shm_allocator::pool_allocator::PoolAllocator;
use iceoryx2_cal::{
    bag, dynamic_storage, event, hash, monitoring, reactor, resizable_shared_memory, serialize, shared_memory,
    static_storage, zero_copy_connection,
};

use super::shared::Shared;

#[derive(Debug, Clone)]
pub(super) struct Service {}

impl iceoryx2::service::Service for Service {
    type StaticStorage = static_storage::recommended::Ipc;
    type ConfigSerializer = serialize::recommended::Recommended;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::recommended::PersistentLocal<T>;
    type Bag = bag::recommended::Recommended;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> = dynamic_storage::recommended::Ipc<T>;
    type ServiceNameHasher = hash::recommended::Recommended;
    type SharedMemory = shared_memory::recommended::Ipc<PoolAllocator>;
    type ResizableSharedMemory = resizable_shared_memory::recommended::Ipc<PoolAllocator>;
    type Connection = zero_copy_connection::recommended::Ipc;
    type Event = event::recommended::Ipc;
    type Monitoring = monitoring::recommended::Ipc;
    type Reactor = reactor::recommended::Ipc;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> = Shared<T>;
    type BlackboardMgmt<T: Send + Sync + Debug + ZeroCopySend + 'static> = dynamic_storage::recommended::Ipc<T>;
    type BlackboardPayload = shared_memory::recommended::Ipc<BumpAllocator>;
    type UniqueId = UniqueSystemId;
}

impl ServiceInternal<Service> for Service {}
