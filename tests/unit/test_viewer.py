from nlos_cam.view.viewer import NullViewer, Viewer


def test_the_null_viewer_has_a_viewers_verbs_and_no_address() -> None:
    viewer: Viewer = NullViewer()
    with viewer as entered:
        assert entered is viewer
        assert entered.address is None
        entered.show(None)  # type: ignore[arg-type]
