"""Neural fields: triplanes, the asset decoder, signed distance and feature networks, opacity."""
