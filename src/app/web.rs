//! Stage page: thread `web`, which serves the page for a phone ([`rapid_web`]).

use std::sync::Arc;

use futures::future::{self, BoxFuture, FutureExt};
use rapid_web::Web;
pub use rapid_web::WebOptions;

use super::AppError;
use super::optional::{Host, Listening, Server};
use super::requests::asker;
use super::stage::Stage;

impl Server for WebOptions {
    fn listen<'a>(self: Box<Self>, host: &'a Host<'a>) -> BoxFuture<'a, Result<Listening, AppError>> {
        let web = Web::start(&self, Arc::clone(host.board), asker(host.conductor)).map_err(AppError::optional);
        future::ready(web.map(|web| Listening {
            shown: None,
            additions: None,
            start: Box::new(|_, _, _| {
                Ok(Stage::start("the page", |stop| async move {
                    web.run(stop).await;
                    Ok(())
                }))
            }),
        }))
        .boxed()
    }
}
